"""README and documentation as one who types along: Python blocks and commands run, page by page.

Blocks of a page run in their order, in one empty folder, so that a command finds what the one
before it wrote. Budgets are small: ``learn`` collects one rollout, cloning takes ten steps, and
commands get the arguments of ``doc_blocks.BUDGETS``. All run in this process, trainings of the
benchmark too. Not run, but parsed by the programs that they start, are commands

- that differ from one before them on the page in the values of their options alone;
- of the benchmark that another page has as well, with any options;
- of a block with a comment ``<!-- not run: WHY -->`` before it;
- of programs that are not this package's (``doc_blocks.NEVER_RUN``).
"""

import argparse
import importlib.util
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from stable_baselines3.common import evaluation
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

import sb3_policyflow.benchmark.run
from sb3_policyflow.benchmark.__main__ import COMMANDS
from sb3_policyflow.imitation.options import CloningOptions
from tests.doc_blocks import (
    NEVER_RUN,
    PAGES,
    ROOT,
    Block,
    blocks,
    inline,
    kind,
    program,
    run,
    with_small_budget,
)

ALL = [
    block for page in PAGES for block in blocks(page) if block.kind == "python" or block.commands()
]
BEFORE = {"docs/zoo.md": ["python -m rl_zoo3.train --algo policyflow --env MultiGoal-v0"]}
"""What a page takes for granted: plots of several runs need a second one."""


@pytest.fixture
def small_budgets(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    learn, evaluate, options = (
        OnPolicyAlgorithm.learn,
        evaluation.evaluate_policy,
        CloningOptions.of,
    )

    def learn_little(self: Any, total_timesteps: int, *args: Any, **kwargs: Any) -> Any:
        assert total_timesteps >= 0
        self.n_epochs = 1
        return learn(self, min(total_timesteps, self.n_steps * self.n_envs), *args, **kwargs)

    def evaluate_little(*args: Any, **kwargs: Any) -> Any:
        return evaluate(*args, **{**kwargs, "n_eval_episodes": 1})

    def clone_little(**kwargs: Any) -> CloningOptions:
        return options(**{**kwargs, "gradient_steps": 10})

    def in_this_process(command: list[str], **_: Any) -> Any:
        run(["python", *command[1:]])
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(OnPolicyAlgorithm, "learn", learn_little)
    monkeypatch.setattr(evaluation, "evaluate_policy", evaluate_little)
    monkeypatch.setattr(CloningOptions, "of", clone_little)
    processes = SimpleNamespace(run=in_this_process, STDOUT=subprocess.STDOUT)
    monkeypatch.setattr(sb3_policyflow.benchmark.run, "subprocess", processes)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.chdir(tmp_path)


def commands_to_run(page: str) -> dict[str, list[list[str]]]:
    """The commands of a page that are run, by the block in which they are."""
    seen: set[tuple[str, ...]] = set()
    elsewhere = {
        program(words)
        for other in PAGES[: PAGES.index(page)]
        for block in blocks(other)
        for words in block.commands()
        if program(words).startswith("sb3_policyflow.benchmark")
    }
    chosen: dict[str, list[list[str]]] = {}
    for block in blocks(page):
        for words in block.commands() if block.reason is None else []:
            is_ours = words[0] not in NEVER_RUN and program(words) not in elsewhere
            if is_ours and kind(words) not in seen:
                seen.add(kind(words))
                chosen.setdefault(str(block), []).append(words)
    return chosen


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*found in sys.modules after import")
@pytest.mark.parametrize("page", dict.fromkeys(block.page for block in ALL))
@pytest.mark.usefixtures("small_budgets")
def test_pages_run(page: str) -> None:
    pytest.importorskip("rl_zoo3")
    commands = commands_to_run(page)
    for line in BEFORE.get(page, []):
        run(with_small_budget(shlex.split(line)))
    for block in blocks(page):
        if block.kind == "python" and block.reason is None:
            # Each by itself: a reader copies one.
            exec(compile(block.text, str(block), "exec"), {"__name__": "__main__"})
        for words in commands.get(str(block), []):
            run(with_small_budget(words))


OPTIONS: dict[str, set[str]] = {}


def options_of(module: str) -> set[str]:
    """The options that a command has, by its help."""
    if module not in OPTIONS:
        command = [sys.executable, "-m", module, "--help"]
        text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        OPTIONS[module] = set(re.findall(r"(?<![\w-])--?[a-z][\w-]*", text))
    return OPTIONS[module]


def parse(words: list[str]) -> None:
    """Have a command parsed by its program; SystemExit if it does not take it."""
    module, arguments = words[2], words[3:]
    if module == "sb3_policyflow.benchmark":
        folder, _ = COMMANDS[arguments[0]]
        parser = argparse.ArgumentParser()
        importlib.import_module(f"sb3_policyflow.benchmark.{folder}").add_arguments(parser)
        parser.parse_args(["0" if word == "N" else word for word in arguments[1:]])
    else:
        assert module.startswith(("rl_zoo3.", "sb3_policyflow.")), words
        options = options_of(module)
        for word in arguments:  # argparse takes an option by its beginning
            if re.match(r"--?[a-z]", word):
                assert any(option.startswith(word) for option in options), words


@pytest.mark.slow
@pytest.mark.parametrize("block", [block for block in ALL if block.commands()], ids=str)
def test_commands_are_ones_that_there_are(block: Block) -> None:
    pytest.importorskip("rl_zoo3")
    makefile = (ROOT / "Makefile").read_text()
    for words in block.commands():
        if words[0] == "make":
            assert all(re.search(rf"(?m)^{target}:", makefile) for target in words[1:])
        elif words[:2] == ["python", "-m"]:
            parse(words)
        elif words[0] == "python" and words[1] != "-c":
            assert (ROOT / words[1]).is_file()
        else:
            assert words[0] in ("python", "rl_zoo3", *NEVER_RUN), words


@pytest.mark.parametrize("page", PAGES)
def test_commands_of_sentences_are_ones_that_there_are(page: str) -> None:
    for words in inline(page):
        if words[1] != "-m":
            assert (ROOT / words[1]).is_file(), words
        elif words[2] == "sb3_policyflow.benchmark":
            assert words[3:] == [] or words[3] in COMMANDS, words
        else:
            assert importlib.util.find_spec(words[2]) is not None, words


def test_few_blocks_are_not_run_and_each_says_why() -> None:
    left_out = [block for block in ALL if block.reason is not None]
    assert len(left_out) <= len(ALL) // 3
    assert all(len(block.reason or "") > 10 for block in left_out)
