"""Statistics of VecNormalize are those of the model, or are refused."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.resilience.normalization import check_normalization, read_statistics
from tests.helpers import SMALL, TINY


def normalized(**options: Any) -> VecNormalize:
    return VecNormalize(make_vec_env("Pendulum-v1"), **options)


def saved(path: Path, env: Any, **options: Any) -> PolicyFlow:
    """A model of this environment, from its file and without the environment."""
    PolicyFlow("MlpPolicy", env, policy_kwargs=TINY, **SMALL).save(path, **options)
    return PolicyFlow.load(path)


MISSING = r"with VecNormalize, .*: give them as statistics \(--vecnormalize FILE\), or cry\."
NEEDLESS = r"observations as the environment gives them, .*: leave out statistics"


def check(model: Any, normalize: VecNormalize | None) -> None:
    check_normalization(model, normalize, "statistics", ", or cry")


def test_a_file_knows_whether_observations_were_normalized(tmp_path: Path) -> None:
    both, rewards = normalized(), normalized(norm_obs=False)
    seen = saved(tmp_path / "seen", both)
    check(seen, both)
    for missing in (None, rewards):
        with pytest.raises(ValueError, match=MISSING):
            check(seen, missing)
    for env in (make_vec_env("Pendulum-v1"), rewards):
        plain = saved(tmp_path / "plain", env)
        check(plain, None)
        check(plain, rewards)
        with pytest.raises(ValueError, match=NEEDLESS):
            check(plain, both)


def test_so_does_an_environment() -> None:
    both = normalized()
    check(PolicyFlow("MlpPolicy", both, policy_kwargs=TINY), both)
    with pytest.raises(ValueError, match=NEEDLESS):
        check(PolicyFlow("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY), both)


@pytest.mark.parametrize("algorithm", [PolicyFlow, FPO, DPPO])
def test_a_file_of_0_1_does_not_know_what_was_normalized(algorithm: type[Any]) -> None:
    data = Path(__file__).parents[1] / "data" / "v0.1"
    model = algorithm.load(data / f"{algorithm.__name__.lower()}.zip", device="cpu")
    check(model, normalized())
    check(model, normalized(norm_obs=False))
    with pytest.raises(ValueError, match=MISSING):
        check(model, None)


def test_a_file_without_a_state_does_not_say(tmp_path: Path) -> None:
    model = saved(tmp_path / "model", normalized(), exclude=["resume_state"])
    assert model.observed() is None
    check(model, None)
    check(model, normalized())
    model.save(tmp_path / "again")
    assert PolicyFlow.load(tmp_path / "again").observed() is None


def test_statistics_are_read(tmp_path: Path) -> None:
    env = normalized(clip_obs=3.0)
    env.reset()
    env.save(str(tmp_path / "stats.pkl"))
    statistics: Any = read_statistics(tmp_path / "stats.pkl")
    np.testing.assert_array_equal(statistics.obs_rms.mean, env.obs_rms.mean)  # type: ignore[union-attr]
    assert (statistics.clip_obs, statistics.venv) == (3.0, None)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", r"cannot be read as statistics of VecNormalize \(Ran out of input\)"),
        (b"PK\x03\x04", "cannot be read as statistics of VecNormalize"),
        (b"cno.such.module\nName\n.", r"cannot be read .*\(No module named 'no'\)"),
        (pickle.dumps({}), "holds a dict, no VecNormalize"),
    ],
)
def test_what_holds_no_statistics(content: bytes, what: str, tmp_path: Path) -> None:
    path = tmp_path / "stats.pkl"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"stats.pkl {what}.*: give a file that VecNormalize.save"):
        read_statistics(path)
