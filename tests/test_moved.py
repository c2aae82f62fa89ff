"""Modules under their old names."""

import importlib
import sys

import pytest

from sb3_policyflow._moved import MOVED


@pytest.mark.parametrize("old", MOVED)
def test_an_old_name_imports_the_module_of_the_new_one(old: str) -> None:
    name = f"sb3_policyflow.{old}"
    sys.modules.pop(name, None)
    with pytest.warns(DeprecationWarning, match=f"is now sb3_policyflow.{MOVED[old]}"):
        module = importlib.import_module(name)
    assert module is importlib.import_module(f"sb3_policyflow.{MOVED[old]}")
