"""Every Python block of README and documentation runs, and every command is one that there is.

Blocks run with small budgets: ``learn`` collects one rollout, and an evaluation is of one episode.
Commands are parsed by the programs that they start, and not carried out: the tests of the commands
do that. A comment ``<!-- not run: WHY -->`` before a block says why it cannot run.
"""

import importlib
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from stable_baselines3.common import evaluation
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_policyflow.benchmark.__main__ import COMMANDS

ROOT = Path(__file__).parents[1]
PAGES = ["README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(
    r"(?ms)(?:<!-- not run: (?P<reason>[^\n]+?) -->\s*)?^```(?P<kind>\w*)\n(?P<text>.*?)^```$"
)
SHELLS = ("sh", "bash", "")
ELSEWHERE = {
    "./isaaclab.sh": "IsaacLab's own",
    "createdb": "PostgreSQL's",
    "export": "the shell's",
    "make": "tests/test_doc_blocks.py looks for its targets",
    "optuna": "Optuna's",
    "optuna-dashboard": "Optuna's",
    "pip": "the installer's",
    "tensorboard": "TensorBoard's",
    "trackio": "trackio's",
}
"""Programs that are not this package's, and whose."""


class Block(NamedTuple):
    page: str
    line: int
    kind: str
    text: str
    reason: str | None

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def blocks(*kinds: str) -> Iterator[Block]:
    for page in PAGES:
        text = (ROOT / page).read_text(encoding="utf-8")
        for match in BLOCK.finditer(text):
            if match["kind"] in kinds:
                line = text[: match.start()].count("\n") + 1
                yield Block(page, line, match["kind"], match["text"], match["reason"])


def commands(block: Block) -> list[list[str]]:
    """The words of each command, in a block of them; none in one of something else."""
    joined = block.text.replace("\\\n", " ")
    lines = [shlex.split(line, comments=True) for line in joined.splitlines()]
    return [words for words in lines if words]


PYTHON = list(blocks("python"))
SHELL = [
    block
    for block in blocks(*SHELLS)
    if block.kind or block.text.startswith(("python ", "rl_zoo3 "))
]


@pytest.fixture
def small_budgets(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    learn, evaluate = OnPolicyAlgorithm.learn, evaluation.evaluate_policy

    def learn_little(self: Any, total_timesteps: int, *args: Any, **kwargs: Any) -> Any:
        assert total_timesteps >= 0
        self.n_epochs = 1
        return learn(self, 1, *args, **kwargs)

    def evaluate_little(*args: Any, **kwargs: Any) -> Any:
        return evaluate(*args, **{**kwargs, "n_eval_episodes": 1})

    monkeypatch.setattr(OnPolicyAlgorithm, "learn", learn_little)
    monkeypatch.setattr(evaluation, "evaluate_policy", evaluate_little)
    monkeypatch.chdir(tmp_path)


def pages_of_blocks() -> dict[str, list[Block]]:
    pages: dict[str, list[Block]] = {}
    for block in PYTHON:
        pages.setdefault(block.page, []).append(block)
    return pages


@pytest.mark.slow
@pytest.mark.parametrize("page", pages_of_blocks())
@pytest.mark.usefixtures("small_budgets")
def test_python_blocks_run(page: str) -> None:
    for block in pages_of_blocks()[page]:
        if block.reason is None:
            # Each by itself: a reader copies one. The files that one writes, the next may read.
            code = compile(block.text, str(block), "exec")
            exec(code, {"__name__": "__main__"})


def parse(words: list[str]) -> None:
    """Have a command parsed by its program; SystemExit if it does not take it."""
    module, arguments = words[2], words[3:]
    if module == "sb3_policyflow.benchmark":
        folder, _ = COMMANDS[arguments[0]]
        import argparse

        parser = argparse.ArgumentParser()
        importlib.import_module(f"sb3_policyflow.benchmark.{folder}").add_arguments(parser)
        parser.parse_args(
            [word.replace("N", "0") if word == "N" else word for word in arguments[1:]]
        )
    elif module == "sb3_policyflow.export":
        from sb3_policyflow.export.__main__ import main

        with pytest.raises(SystemExit, match="There is no file"):
            main(arguments)
    else:
        ours = "sb3_policyflow.imitation", "sb3_policyflow.integrations.isaaclab"
        assert module.startswith(("rl_zoo3.", *ours)), words
        options = options_of(module)
        for word in arguments:  # argparse takes an option by its beginning
            if re.match(r"--?[a-z]", word):
                assert any(option.startswith(word) for option in options), words


def options_of(module: str) -> set[str]:
    """The options that a command has, by its help."""
    if module not in OPTIONS:
        command = [sys.executable, "-m", module, "--help"]
        text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        OPTIONS[module] = set(re.findall(r"(?<![\w-])--?[a-z][\w-]*", text))
    return OPTIONS[module]


OPTIONS: dict[str, set[str]] = {}


@pytest.mark.slow
@pytest.mark.parametrize("block", SHELL, ids=str)
def test_commands_are_ones_that_there_are(block: Block) -> None:
    pytest.importorskip("rl_zoo3")
    makefile = (ROOT / "Makefile").read_text()
    for words in commands(block):
        if words[0] == "make":
            assert all(re.search(rf"(?m)^{target}:", makefile) for target in words[1:])
        elif words[:2] == ["python", "-m"]:
            parse(words)
        elif words[0] == "python" and words[1] != "-c":
            assert (ROOT / words[1]).is_file()
        elif words[0] == "rl_zoo3":
            assert words[1] in ("plot_train", "all_plots", "plot_from_file")
        else:
            assert words[0] == "python" or words[0] in ELSEWHERE, words


def test_few_blocks_are_not_run_and_each_says_why() -> None:
    left_out = [block for block in PYTHON if block.reason is not None]
    assert len(left_out) <= len(PYTHON) // 3
    assert all(len(block.reason or "") > 10 for block in left_out)
