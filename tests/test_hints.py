"""Hints name what there is, and a command that works from where the user is."""

import json
from importlib import metadata
from pathlib import Path

import pytest

from sb3_policyflow.hints import did_you_mean, install_command, requirement

METADATA = "Metadata-Version: 2.4\nName: sb3-policyflow\nVersion: 1.0\n"


def installed(folder: Path, origin: object, metadata_text: str = METADATA) -> metadata.Distribution:
    """A distribution as an installer leaves it, with a note of where it came from."""
    folder /= "sb3_policyflow-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text(metadata_text)
    if origin is not None:
        (folder / "direct_url.json").write_text(json.dumps(origin))
    return metadata.PathDistribution(folder)


def test_in_a_checkout_the_command_names_its_folder() -> None:
    root = Path(__file__).parents[1]
    assert install_command("robotics") == f'pip install "{root}[robotics]"'
    assert install_command("onnx", upgrade=True).startswith("pip install --upgrade --upgrade-str")


def test_what_was_installed_from_a_folder_is_installed_from_it_again(tmp_path: Path) -> None:
    origin = {"url": tmp_path.as_uri(), "dir_info": {}}
    assert requirement("zoo", installed(tmp_path, origin)) == f"{tmp_path}[zoo]"


def test_what_was_installed_from_an_address_is_installed_from_it_again(tmp_path: Path) -> None:
    origin = {"url": "https://host/x.git", "vcs_info": {"vcs": "git", "commit_id": "0"}}
    expected = "sb3-policyflow[zoo] @ git+https://host/x.git"
    assert requirement("zoo", installed(tmp_path, origin)) == expected


@pytest.mark.parametrize("origin", [None, {"url": "file:///gone", "dir_info": {}}])
def test_otherwise_the_repository_of_the_metadata_has_it(tmp_path: Path, origin: object) -> None:
    text = f"{METADATA}Project-URL: Repository, https://host/y\n"
    found = requirement("zoo", installed(tmp_path, origin, text))
    assert found == "sb3-policyflow[zoo] @ git+https://host/y"


def test_without_a_similar_name_all_are_listed() -> None:
    assert did_you_mean("zzz", ["b", "a"]) == "there are a, b."
