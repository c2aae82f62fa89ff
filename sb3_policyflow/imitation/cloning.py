"""Cloning: supervised training of a policy's actor on demonstrations."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import configure_logger

from sb3_policyflow.common.algorithm import FlowOnPolicyAlgorithm
from sb3_policyflow.imitation.demonstrations import load_demonstrations
from sb3_policyflow.imitation.fitting import check_spaces
from sb3_policyflow.imitation.options import CloningOptions
from sb3_policyflow.imitation.samples import CloningSamples
from sb3_policyflow.imitation.training import CloningRun

Model = TypeVar("Model", bound=OnPolicyAlgorithm)


def clone(
    model: Model,
    demonstrations: Any,
    gradient_steps: int = 6000,
    callback: MaybeCallback = None,
    progress_bar: bool = False,
    **options: Any,
) -> Model:
    """Train a model's actor to act as demonstrators did; then ``learn`` goes on from there.

    PolicyFlow and FPO learn by conditional flow matching along their own interpolant, DPPO by the
    denoising loss of its process, and Gaussian policies (PolicyFlow with ``gaussian=True``, SB3's
    PPO and A2C) by maximum likelihood. The networks, the optimizer's class and options,
    ``max_grad_norm`` and the device are the model's; the critic learns nothing.

    A ``VecNormalize`` of the model that has not seen an observation takes its statistics from the
    demonstrations, and one that has keeps its own. Actions beyond their bounds count as the bounds,
    to which SB3 clips them. The parameters with the least validation loss are kept. The random
    generators are left as they were.

    Logged are ``imitation/loss``, ``validation_loss``, ``best_validation_loss``, ``learning_rate``
    and ``gradient_steps``. Callbacks are asked after each gradient step, and may stop the cloning.

    >>> import numpy as np
    >>> from sb3_policyflow import PolicyFlow
    >>> shown = np.random.randn(256, 3), np.zeros((256, 1))
    >>> model = clone(PolicyFlow("MlpPolicy", "Pendulum-v1"), shown, gradient_steps=20)

    :param model: The model, of this package or an on-policy algorithm of SB3.
    :param demonstrations: What :func:`load_demonstrations` takes: arrays, transitions, a Minari
        dataset, or the name of one.
    :param gradient_steps: Steps of the optimizer, at most.
    :param callback: Callbacks of SB3, or a function.
    :param progress_bar: Whether to show a progress bar.
    :param batch_size: Transitions of a step; all if there are fewer. Default: 1024.
    :param learning_rate: A number, "lin_START", "lin_START_END" or a function of the remaining
        progress. Default: "lin_0.001".
    :param noise_std: Standard deviation of PolicyFlow's noise when it has been cloned, which is
        what it explores with; by default 0.1 where actions are from -1 to 1, and in proportion, or
        0.1 where bounds are 200 or more apart, which seem to stand for none.
    :param validation_fraction: Part of the demonstrations that is held out, whole episodes if they
        are known; 0 for none. Default: 0.1.
    :param eval_freq: Gradient steps from one validation to the next. Default: 200.
    :param patience: Validations without improvement after which cloning stops; None to go on to
        the end. Default: 15.
    :param seed: Seed of all draws; by default the model's, and without that the present state of
        the random generators.
    :param checkpoint: A file in which an interrupted cloning finds its state, and continues to the
        same parameters to the last bit. It is written at each validation and removed at the end.
    :return: The model.
    :raises ValueError: If demonstrations or options cannot be used.
    :raises TypeError: If there is no such option, or the model's algorithm is not on-policy.
    :raises FloatingPointError: If the loss is not finite.
    """
    if not isinstance(model, OnPolicyAlgorithm):
        raise TypeError(
            f"{type(model).__name__} cannot be cloned from demonstrations, only on-policy "
            "algorithms can: use PolicyFlow, FPO, DPPO, or PPO or A2C of Stable-Baselines3."
        )
    chosen = CloningOptions.of(gradient_steps=gradient_steps, **options)
    shown = load_demonstrations(demonstrations)
    check_spaces(shown, model)
    run = CloningRun(model, CloningSamples(model, shown), chosen)
    with _prepared(model, callback) as asked:
        run.train(asked, progress_bar)
    if isinstance(model, FlowOnPolicyAlgorithm):
        model.policy.finish_cloning(chosen.noise_std)
        state = model.policy.state_dict()
        model.cloned_parameters = {name: values.cpu().numpy() for name, values in state.items()}
    return model


@contextmanager
def _prepared(model: Any, callback: MaybeCallback) -> Iterator[BaseCallback]:
    """A block with a callback that has begun, and a logger as ``learn`` would make it."""
    if isinstance(callback, list):
        callback = CallbackList(callback)
    if not isinstance(callback, BaseCallback):
        callback = ConvertCallback(callback)
    if not model._custom_logger:
        model._logger = configure_logger(model.verbose, model.tensorboard_log, "imitation", True)
    callback.init_callback(model)
    callback.on_training_start(locals(), globals())
    yield callback
    callback.on_training_end()
