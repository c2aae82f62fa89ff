"""What the package costs at interpreter start: run ``python tests/zoo/startup_cost.py``.

Medians over interpreters that are started in turns with and without the package installed, in
environments that are otherwise the same. Wants an idle machine.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from installation import Environment, build

CODES = {"interpreter start": "pass", "import gymnasium": "import gymnasium"}


def seconds(environment: Environment, code: str) -> float:
    start = time.perf_counter()
    subprocess.run([environment.python, "-c", code], check=True)
    return time.perf_counter() - start


def compare(environments: dict[str, Environment], code: str, repeats: int) -> dict[str, float]:
    """Median milliseconds of some code in each environment; the first round does not count."""
    rounds = [
        {name: seconds(environment, code) for name, environment in environments.items()}
        for _ in range(repeats + 1)
    ][1:]
    return {name: 1e3 * statistics.median(r[name] for r in rounds) for name in environments}


def report(repeats: int) -> str:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        environments = {
            "without": Environment.create(folder / "without"),
            "with": Environment.create(folder / "with").install(build("wheel", folder)),
        }
        lines = [f"{'median of ' + str(repeats):20}{'without':>10}{'with':>10}{'difference':>12}"]
        for title, code in CODES.items():
            medians = compare(environments, code, repeats)
            difference = medians["with"] - medians["without"]
            figures = f"{medians['without']:7.2f} ms{medians['with']:7.2f} ms{difference:9.2f} ms"
            lines.append(f"{title:20}{figures}")
        return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=200)
    sys.stdout.write(report(parser.parse_args().repeats))
