"""The blocks of README and documentation, and how a command among them runs with small budgets."""

import re
import runpy
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PAGES = [
    *("README.md", "CONTRIBUTING.md"),
    *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md"))),
    *(f"docs/tutorials/{path.name}" for path in sorted((ROOT / "docs/tutorials").glob("*.md"))),
]
"""Python cells of tutorials run when the documentation is built."""
BLOCK = re.compile(
    r"(?ms)(?:<!-- not run: (?P<reason>[^\n]+?) -->\s*)?^```(?P<kind>[^\n]*)\n(?P<text>.*?)^```$"
)
SHELL = ("sh", "bash", "")
NEVER_RUN = {
    "createdb": "PostgreSQL's",
    "export": "the shell's",
    "huggingface-cli": "Hugging Face's, which uploads",
    "make": "installs; its targets are looked for",
    "optuna": "Optuna's",
    "optuna-dashboard": "Optuna's, and serves until it is stopped",
    "pip": "the installer's",
    "tensorboard": "TensorBoard's, and serves until it is stopped",
    "torchrun": "PyTorch's",
    "trackio": "trackio's, and serves until it is stopped",
    "./isaaclab.sh": "IsaacLab's own",
}
"""Programs that are not this package's, and whose."""
TRAINING = {
    "-n": ["256"],
    "--eval-freq": ["100"],
    "--eval-episodes": ["2"],
    "--save-freq": ["100"],
    "--n-trials": ["2"],
    "-params": ["n_envs:2", "n_steps:64", "batch_size:64", "n_epochs:1"],
}
BENCHMARK = {"--steps": ["1"], "--seeds": ["0"], "--evaluations": ["1"], "--episodes": ["1"]}
BUDGETS: dict[str, dict[str, list[str]]] = {
    "rl_zoo3.train": TRAINING,
    "rl_zoo3.enjoy": {"-n": ["60"], "--no-render": []},
    "rl_zoo3.record_video": {"-n": ["20"]},
    "sb3_policyflow.benchmark card": {"--episodes": ["2"]},
    "sb3_policyflow.benchmark demo": {"--steps": ["1"], "--seed": ["0"]},
    "sb3_policyflow.benchmark imitation": {
        **BENCHMARK,
        "--algos": ["policyflow"],
        "--styles": ["good"],
    },
    "sb3_policyflow.benchmark multigoal": {**BENCHMARK, "--variants": ["a-ppo", "f-brownian"]},
    "sb3_policyflow.benchmark pointmaze": {**BENCHMARK, "--variants": ["d-brownian"]},
    "sb3_policyflow.benchmark run": {
        **BENCHMARK,
        "--algos": ["policyflow", "ppo"],
        "--envs": ["Pendulum-v1"],
        "--jobs": ["1"],
    },
    "sb3_policyflow.imitation": {"--gradient-steps": ["10"], "-params": TRAINING["-params"]},
    "sb3_policyflow.imitation.demonstrate": {"--episodes": ["2"]},
    "sb3_policyflow.imitation.record": {"--episodes": ["2"]},
    "tests/scripts/fuzz.py": {"": ["3", "11"]},
    "tests/scripts/kill_during_save.py": {"": ["1"]},
}
"""What a program is given, in the place of what the documentation gives it, or in addition.

``-params`` is added to; "" stands for all arguments. Other programs get what is written.
"""


class Block(NamedTuple):
    """A block of a page; ``reason`` says why it cannot run, or is None."""

    page: str
    line: int
    kind: str
    text: str
    reason: str | None

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"

    def commands(self) -> list[list[str]]:
        """The words of each command, if it is a block of them."""
        is_shell = self.kind in ("sh", "bash") or (
            self.kind == "" and self.text.startswith(("python ", "rl_zoo3 "))
        )
        joined = self.text.replace("\\\n", " ") if is_shell else ""
        lines = [shlex.split(line, comments=True) for line in joined.splitlines()]
        return [words for words in lines if words]


def blocks(page: str) -> Iterator[Block]:
    """The blocks of a page, in their order."""
    text = (ROOT / page).read_text(encoding="utf-8")
    for match in BLOCK.finditer(text):
        line = text[: match.start()].count("\n") + 1
        yield Block(page, line, match["kind"], match["text"], match["reason"])


def inline(page: str) -> list[list[str]]:
    """The words of each Python command that a sentence of a page names."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return [shlex.split(code) for code in re.findall(r"`(python [^`]+)`", text)]


def program(words: list[str]) -> str:
    """Which program a command starts, with the subcommand if it has any."""
    if words[0] != "python":
        return " ".join(words[:2]) if words[0] == "rl_zoo3" else words[0]
    if words[1] == "-c":
        return "rl_zoo3.train" if "rl_zoo3.train" in words[2] else "-c"
    if words[1] == "-m":
        has_subcommand = words[2] == "sb3_policyflow.benchmark"
        return " ".join(words[2:4]) if has_subcommand else words[2]
    return words[1]


def kind(words: list[str]) -> tuple[str, ...]:
    """The program and the names of its options: commands of one kind differ in the values alone."""
    options = sorted({word for word in words if re.match(r"--?[a-zA-Z]", word)})
    return (program(words), *options)


def with_small_budget(words: list[str]) -> list[str]:
    """A command that is done in seconds.

    >>> with_small_budget(["python", "-m", "rl_zoo3.enjoy", "-n", "500", "-f", "logs"])
    ['python', '-m', 'rl_zoo3.enjoy', '-f', 'logs', '-n', '60', '--no-render']
    """
    budget = BUDGETS.get(program(words), {})
    if "" in budget:
        return [*words[:2], *budget[""]]
    for option, values in budget.items():
        if option == "-params" and "sac" in words:
            continue  # it has no rollouts
        given: list[str] = []
        if option in words:
            start = words.index(option)
            end = start + 1
            while end < len(words) and not re.match(r"--?[a-zA-Z]", words[end]):
                end += 1
            given, words = words[start + 1 : end], words[:start] + words[end:]
        words = [*words, option, *(given if option == "-params" else []), *values]
    return words


def run(words: list[str]) -> None:
    """Run a Python program in this process, as if it had been started by a command.

    :param words: The command's.
    :raises RuntimeError: If the program ends with an exit code.
    """
    former, path = sys.argv, list(sys.path)
    try:
        if words[0] == "rl_zoo3":
            sys.argv = words
            runpy.run_module("rl_zoo3.cli", run_name="__main__", alter_sys=False)
        elif words[1] == "-m":
            sys.argv = words[2:]
            runpy.run_module(words[2], run_name="__main__", alter_sys=False)
        elif words[1] == "-c":
            sys.argv = ["-c", *words[3:]]
            exec(compile(words[2], "-c", "exec"), {"__name__": "__main__"})
        else:
            sys.argv = words[1:]
            sys.path.insert(0, str((ROOT / words[1]).parent))
            runpy.run_path(str(ROOT / words[1]), run_name="__main__")
    except SystemExit as end:
        if end.code not in (None, 0):
            raise RuntimeError(f"{' '.join(words)} ended with {end.code!r}") from end
    finally:
        sys.argv, sys.path = former, path
