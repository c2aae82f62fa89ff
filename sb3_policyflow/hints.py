"""What error messages advise: the nearest names, and the command that installs an extra."""

import json
from collections.abc import Collection, Iterable, Mapping
from difflib import get_close_matches
from importlib import metadata
from pathlib import Path
from typing import Any

DISTRIBUTION = "sb3-policyflow"


def either(names: Iterable[str]) -> str:
    """The names in a sentence.

    >>> either(["a", "b", "c"])
    'a, b or c'
    """
    *others, last = names
    return f"{', '.join(others)} or {last}" if others else last


def nearest(name: str, known: Collection[str]) -> list[str]:
    """The known names that ``name`` may be meant for, the most similar first.

    >>> nearest("n_epoch", ["n_epochs", "gamma"])
    ['n_epochs']
    """
    return get_close_matches(name, sorted(known), cutoff=0.55)


def did_you_mean(name: str, known: Collection[str], otherwise: str = "") -> str:
    """A question with the names that may be meant, for the end of an error message.

    >>> did_you_mean("MlpPolcy", ["MlpPolicy", "CnnPolicy"])
    'did you mean MlpPolicy or CnnPolicy?'

    :param name: What the user wrote.
    :param known: What there is.
    :param otherwise: What to say if nothing is similar; by default, what there is.
    """
    similar = nearest(name, known)
    if similar:
        return f"did you mean {either(similar)}?"
    return otherwise or f"there are {', '.join(sorted(known))}."


def refuse_both_names(given: Mapping[str, Any], former_names: Mapping[str, str]) -> None:
    """Refuse an argument that is given under its former name and under its present one.

    :param given: Arguments by name.
    :param former_names: Present names by former ones; "DICTIONARY.KEY" for an argument that has
        become a key of another one.
    :raises ValueError: With the name to leave out.
    """
    for former in sorted(former_names.keys() & given.keys()):
        name, _, key = former_names[former].partition(".")
        if key in (given.get(name) or ()) if key else name in given:
            present = f"{name} with the key {key}" if key else name
            raise ValueError(f"{former} is now {present}, and both are given: leave out {former}.")


def install_command(extra: str, upgrade: bool = False) -> str:
    """The command that installs an extra from where this package was installed from.

    :param extra: Name of the extra.
    :param upgrade: Whether to upgrade all that the extra brings.
    """
    options = "--upgrade --upgrade-strategy eager " if upgrade else ""
    return f'pip install {options}"{_requirement(extra)}"'


def _requirement(extra: str) -> str:
    """What pip takes for this package with an extra: a checkout, an address, or its name."""
    checkout = Path(__file__).parents[1]
    if (checkout / "pyproject.toml").is_file():
        return f"{checkout}[{extra}]"
    try:
        installed = metadata.distribution(DISTRIBUTION)
    except metadata.PackageNotFoundError:  # in a bundle
        return f"{DISTRIBUTION}[{extra}]"
    return requirement(extra, installed)


def requirement(extra: str, installed: metadata.Distribution) -> str:
    """What pip takes for an installed distribution with an extra.

    Installers note where a distribution came from (PEP 610); without a note it has come from an
    index, or as a file that may be gone, and the repository of the project's metadata has it.

    :param extra: Name of the extra.
    :param installed: The distribution.
    """
    origin: dict[str, Any] = json.loads(installed.read_text("direct_url.json") or "{}")
    url = origin.get("url", "")
    if "dir_info" in origin and Path(url.removeprefix("file://")).is_dir():
        return f"{url.removeprefix('file://')}[{extra}]"
    if "vcs_info" in origin:
        return f"{DISTRIBUTION}[{extra}] @ {origin['vcs_info']['vcs']}+{url}"
    urls = dict(line.split(", ", 1) for line in installed.metadata.get_all("Project-URL") or ())
    if "Repository" in urls:
        return f"{DISTRIBUTION}[{extra}] @ git+{urls['Repository']}"
    return f"{DISTRIBUTION}[{extra}]"
