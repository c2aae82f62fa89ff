"""The files of a benchmark: what a run of it is, and what came of it.

A folder holds ``NAME/ENV/seed-N.json`` (settings, final evaluations, costs, versions) and
``seed-N.csv`` (evaluations over time) for each run: one algorithm, environment and seed.
"""

import csv
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sb3_policyflow.benchmark.errors import BenchmarkError
from sb3_policyflow.resilience.files import atomic_write

DEFAULT_FOLDER = Path("benchmark-results")

PROGRESS = "trained: "
"""With what a line of a training's log begins that says how far it is."""

CURVE_FIELDS = ("timesteps", "mode", "mean_return", "std_return", "mean_length", "n_episodes")


@dataclass(frozen=True)
class Run:
    """One training.

    :param name: What the tables call it: the algorithm's name, or that of a variant.
    :param algo: rl_zoo3's name of the algorithm.
    :param env: Id of the environment.
    :param seed: Seed of the training.
    :param steps: Environment steps.
    :param hyperparams: What differs from the YAML file.
    :param n_evaluations: Evaluations, evenly over the training, the last one at its end.
    :param n_episodes: Episodes of an evaluation, in each mode.
    :param n_trajectories: Episodes from one start, of which the goals are counted, and which
        MultiGoal keeps; 0 for none.
    :param keep_visits: Whether to count where in the medium maze the training goes.
    """

    name: str
    algo: str
    env: str
    seed: int
    steps: int
    hyperparams: dict[str, Any] = field(default_factory=dict)
    n_evaluations: int = 10
    n_episodes: int = 20
    n_trajectories: int = 0
    keep_visits: bool = False

    def __str__(self) -> str:
        return f"{self.name} {self.env} seed {self.seed}"

    def path(self, folder: Path, suffix: str) -> Path:
        """Where a file of it is, for instance with the suffix ".json"."""
        return folder / self.name / self.env.replace("/", "-") / f"seed-{self.seed}{suffix}"

    def as_json(self) -> str:
        """Its fields, as its results and the process that trains it get them.

        :raises BenchmarkError: If a hyperparameter has no JSON.
        """
        for name, value in self.hyperparams.items():
            _require_json(name, value)
        return json.dumps(asdict(self))

    def is_done(self, folder: Path) -> bool:
        """Whether its results are there.

        :raises BenchmarkError: If they are, and were made with other settings; or if this run could
            not be written.
        """
        # In JSON a tuple is a list.
        written, path = Run(**json.loads(self.as_json())), self.path(folder, ".json")
        if not path.is_file():
            return False
        run, _ = _read_summary(path)
        if run != written:
            raise BenchmarkError(
                f"{path} was made with other settings, {asdict(run)}: choose another --out, or "
                "delete it."
            )
        return True


@dataclass(frozen=True)
class Result:
    """What came of a run: ``summary`` as in its JSON file, ``curve`` the rows of its CSV file."""

    run: Run
    summary: dict[str, Any]
    curve: list[dict[str, Any]]

    def save(self, folder: Path) -> None:
        """Write both files; the run counts as done once the JSON file is there."""
        path = self.run.path(folder, ".json")
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path.with_suffix(".csv"), "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, CURVE_FIELDS)
            writer.writeheader()
            writer.writerows(self.curve)
        text = json.dumps({"run": asdict(self.run), **self.summary}, indent=1)
        with atomic_write(path) as file:
            file.write(f"{text}\n".encode())

    @classmethod
    def load(cls, path: Path) -> "Result":
        """Read what ``save`` wrote.

        :param path: The JSON file.
        """
        run, summary = _read_summary(path)
        with open(path.with_suffix(".csv"), newline="", encoding="utf-8") as file:
            curve: list[dict[str, Any]] = [
                {key: value if key == "mode" else float(value) for key, value in row.items()}
                for row in csv.DictReader(file)
            ]
        return cls(run, summary, curve)

    def final_return(self, mode: str) -> float | None:
        """Mean return at the end of the training; None if there is no such mode."""
        evaluation = self.summary["final"].get(mode)
        return None if evaluation is None else float(evaluation["mean_return"])

    def returns(self, mode: str) -> tuple[list[float], list[float]]:
        """Timesteps and mean returns over the training."""
        rows = [row for row in self.curve if row["mode"] == mode]
        return [row["timesteps"] for row in rows], [row["mean_return"] for row in rows]


def _require_json(name: str, value: object) -> None:
    """Refuse a hyperparameter that no JSON file can hold.

    :raises BenchmarkError: With how to write it.
    """
    try:
        json.dumps(value)
    except (TypeError, ValueError) as error:
        raise BenchmarkError(
            f"{name}:{value!r} cannot be written to a JSON file ({error}). Write a dictionary with "
            "such values as a quoted string, \"policy_kwargs:'dict(...)'\", as rl_zoo3's YAML "
            "files do."
        ) from error


def _read_summary(path: Path) -> tuple[Run, dict[str, Any]]:
    """A run, whose newest fields an earlier version may not have written, and the rest of its file.

    :raises BenchmarkError: If it has fields that this version does not know.
    """
    summary = json.loads(path.read_text(encoding="utf-8"))
    # Version 0.1.0 wrote "cell".
    settings = summary.pop("run" if "run" in summary else "cell")
    try:
        return Run(**settings), summary
    except TypeError as error:
        raise BenchmarkError(
            f"{path} is of another version of this package ({error}): choose another folder, or "
            "delete it."
        ) from error


def load_results(folder: Path, envs: Sequence[str] = ()) -> list[Result]:
    """What has been run, in the order of names, environments and seeds.

    :param folder: Where it is.
    :param envs: Environments to take; all if not given.
    :raises BenchmarkError: If there is nothing.
    """
    results = [Result.load(path) for path in folder.glob("*/*/seed-*.json")]
    results = [result for result in results if not envs or result.run.env in envs]
    if not results:
        which = f" of {', '.join(envs)}" if envs else ""
        raise BenchmarkError(f"No results{which} in {folder}: make some with the command run.")
    return sorted(results, key=lambda r: (r.run.name, r.run.env, r.run.seed))


def distinct(results: Sequence[Result], what: str) -> list[str]:
    """The names ("name") or environments ("env") in some results, in their order."""
    return list(dict.fromkeys(getattr(result.run, what) for result in results))


def select(results: Sequence[Result], name: str, env: str) -> list[Result]:
    """The seeds of one name in one environment."""
    return [r for r in results if (r.run.name, r.run.env) == (name, env)]
