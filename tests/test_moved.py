"""Modules that have moved are still found under their old names."""

import importlib
import subprocess
import sys

import pytest

from sb3_policyflow._moved import MOVED

OF_PACKAGES = {
    "envs.isaaclab.presets": "integrations.isaaclab.presets",
    "fused.compiler": "kernels.compiler",
    "zoo.samplers": "integrations.rl_zoo3.samplers",
}
"""Some modules of packages that have moved."""


@pytest.fixture(autouse=True)
def _not_imported_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the first import of an old name warns."""
    for old in MOVED | OF_PACKAGES:
        monkeypatch.delitem(sys.modules, f"sb3_policyflow.{old}", raising=False)


@pytest.mark.parametrize(("old", "new"), [*MOVED.items(), *OF_PACKAGES.items()])
def test_an_old_name_imports_the_new_module(old: str, new: str) -> None:
    sentence = f"sb3_policyflow.{old} is now sb3_policyflow.{new}: import it from there"
    with pytest.warns(DeprecationWarning, match=sentence):
        module = importlib.import_module(f"sb3_policyflow.{old}")
    assert module is importlib.import_module(f"sb3_policyflow.{new}")


def test_other_names_are_missing() -> None:
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'sb3_policyflow\.zoos'"):
        importlib.import_module("sb3_policyflow.zoos")
    with pytest.raises(ModuleNotFoundError, match=r"sb3_policyflow\.zoo\.nothing"):
        importlib.import_module("sb3_policyflow.zoo.nothing")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["integrations.isaaclab", "envs.isaaclab"])
def test_commands_run_under_both_names(name: str) -> None:
    command = [sys.executable, "-W", "always", "-m", f"sb3_policyflow.{name}", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "usage: python -m sb3_policyflow.integrations.isaaclab" in done.stdout
    warned = "DeprecationWarning: sb3_policyflow.envs.isaaclab is now" in done.stderr
    assert warned == (name == "envs.isaaclab")
