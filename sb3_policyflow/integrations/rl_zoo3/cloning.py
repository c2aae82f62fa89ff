"""Cloning from demonstrations before rl_zoo3 trains."""

import warnings
from typing import Any

from sb3_policyflow.imitation import clone


class CloningBeforeTraining:
    """Takes the hyperparameters ``demonstrations`` and ``imitation_kwargs``, and clones with them.

    ``demonstrations`` is a name "minari:DATASET" or the path of an ``.npz`` file,
    ``imitation_kwargs`` a dictionary of other arguments of
    :func:`~sb3_policyflow.imitation.clone`. They are taken out before rl_zoo3 makes the model.

    :param manager: rl_zoo3's ``ExperimentManager``, two of whose methods are replaced.
    """

    def __init__(self, manager: Any) -> None:
        self._manager = manager
        self._demonstrations: str | None = None
        self._options: dict[str, Any] = {}
        self._preprocess, self._setup = manager._preprocess_hyperparams, manager.setup_experiment
        manager._preprocess_hyperparams = self.preprocess
        manager.setup_experiment = self.setup

    def preprocess(self, hyperparams: dict[str, Any]) -> Any:
        """What rl_zoo3 makes of the other hyperparameters.

        :param hyperparams: Those of the YAML file and of the command line.
        :raises SystemExit: If demonstrations cannot be used here: a command ends without traceback.
        """
        self._demonstrations = hyperparams.pop("demonstrations", None)
        options = hyperparams.pop("imitation_kwargs", None) or {}
        if not isinstance(options, dict):
            raise SystemExit(
                f"imitation_kwargs must be a dictionary of arguments of clone, got {options!r}."
            )
        self._options = options
        if options and self._demonstrations is None:
            raise SystemExit(
                "imitation_kwargs needs demonstrations: name a dataset, or leave it out."
            )
        if self._demonstrations is not None and self._manager.optimize_hyperparameters:
            raise SystemExit(
                "Trials of --optimize do not clone: leave out demonstrations, or clone first with "
                "python -m sb3_policyflow.imitation."
            )
        return self._preprocess(hyperparams)

    def setup(self) -> Any:
        """What rl_zoo3 sets up, with a model that has been cloned.

        :raises SystemExit: If ``clone`` refuses the model, the demonstrations or its arguments.
        """
        made = self._setup()
        if made is None or self._demonstrations is None:
            return made
        model = made[0]
        if self._manager.continue_training:
            warnings.warn(
                f"{self._manager.trained_agent} is trained further and not cloned again from "
                f"{self._demonstrations}.",
                stacklevel=2,
            )
            return made
        options = {"progress_bar": self._manager.show_progress, **self._options}
        try:
            clone(model, self._demonstrations, **options)
        except (TypeError, ValueError) as error:
            raise SystemExit(str(error)) from error
        return made
