"""Files of ``VecNormalize``, and whether a model was trained with one."""

import pickle
from pathlib import Path

from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow.resilience.resumable import ResumableOnPolicyAlgorithm


def read_statistics(path: str | Path) -> VecNormalize:
    """What ``VecNormalize.save`` wrote, without an environment.

    :param path: The file.
    :raises ValueError: If it holds nothing of the kind.
    """
    advice = "give a file that VecNormalize.save wrote."
    try:
        statistics = pickle.loads(Path(path).read_bytes())
    except Exception as error:  # a pickle may raise anything
        reason = str(error).partition("\n")[0]
        raise ValueError(
            f"{path} cannot be read as statistics of VecNormalize ({reason}): {advice}"
        ) from error
    if not isinstance(statistics, VecNormalize):
        raise ValueError(f"{path} holds a {type(statistics).__name__}, no VecNormalize: {advice}")
    return statistics


def check_normalization(
    model: ResumableOnPolicyAlgorithm,
    normalize: VecNormalize | None,
    name: str,
    otherwise: str = "",
) -> None:
    """Refuse to show a model observations of another scale than in its training.

    Where neither its environment nor its file says how it was trained, nothing is refused.

    :param model: The model.
    :param normalize: What is to normalize its observations.
    :param name: What the user calls that.
    :param otherwise: What else can be done if it is missing, to go on with the sentence.
    :raises ValueError: If statistics are missing, or there are some that the model does not know.
    """
    observed = model.observed()
    if observed is None:
        return
    wanted, given = observed.is_normalized, normalize is not None and normalize.norm_obs
    # Version 0.1.0 did not note whether VecNormalize normalized observations or only rewards.
    if (wanted and not given) or (wanted is None and normalize is None):
        raise ValueError(
            "The model was trained with VecNormalize, without whose statistics its actions are "
            f"wrong: give them as {name} (--vecnormalize FILE){otherwise}."
        )
    if wanted is False and given:
        raise ValueError(
            "The model was trained with observations as the environment gives them, and its "
            f"actions for normalized ones are wrong: leave out {name} (--vecnormalize)."
        )
