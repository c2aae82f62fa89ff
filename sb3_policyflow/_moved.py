"""Modules under the names that earlier versions gave them.

Models that were saved by an earlier version name its modules, and so may users' scripts. Importing
an old name imports the module that took its place, with a ``DeprecationWarning``.
"""

import importlib
import importlib.util
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import InspectLoader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import CodeType, ModuleType

MOVED = {
    "benchmark.cell": "benchmark.train_one",
    "benchmark.costs": "benchmark.measure.costs",
    "benchmark.environments": "benchmark.speed.environments",
    "benchmark.evaluation": "benchmark.measure.evaluation",
    "benchmark.goals": "benchmark.measure.goals",
    "benchmark.panels": "benchmark.variants",
    "benchmark.plot": "benchmark.figures.plot",
    "benchmark.plots": "benchmark.figures.goals",
    "benchmark.speed_settings": "benchmark.speed.settings",
    "benchmark.statistics": "benchmark.report.statistics",
    "benchmark.table": "benchmark.report.table",
    "benchmark.timing": "benchmark.speed.timing",
    "benchmark.visits": "benchmark.measure.visits",
    "common.aliases": "common.policies",
    "common.arguments": "common.algorithm",
    "common.callbacks": "resilience.checkpoints",
    "common.chunks": "common.tree",
    "common.collection": "resilience.collection",
    "common.files": "resilience.files",
    "common.finite": "resilience.finite",
    "common.learning_rate": "common.schedules",
    "common.metrics": "common.update",
    "common.ode_policy": "common.policies",
    "common.on_policy_algorithm": "common.algorithm",
    "common.optimisation": "common.optimization",
    "common.saving": "resilience.saving",
    "common.type_aliases": "common.tree",
    "common.workers": "resilience.workers",
    "diagnostics": "callbacks",
    "envs.isaaclab": "integrations.isaaclab",
    "envs.playground_names": "envs.task_names",
    "envs.playground_tasks": "envs.playground.tasks",
    "envs.point_masses": "envs.multigoal.point_masses",
    "flows.paths": "flows.interpolants",
    "fused": "kernels",
    "startup": "integrations.rl_zoo3.startup",
    "zoo": "integrations.rl_zoo3",
    "zoo.vector": "envs.native",
}
"""New names by old ones, within this package; those of packages hold for the modules in them."""

_ROOT = f"{__package__}."


class MovedModules(MetaPathFinder, InspectLoader):
    """Finds the modules of :data:`MOVED` under their old names."""

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None = None,  # noqa: ARG002
        target: ModuleType | None = None,  # noqa: ARG002
    ) -> ModuleSpec | None:
        new_name = new_name_of(fullname)
        found = importlib.util.find_spec(new_name) if new_name else None
        if found is None:
            return None
        is_package = found.submodule_search_locations is not None
        return ModuleSpec(fullname, self, is_package=is_package)

    def exec_module(self, module: ModuleType) -> None:
        new_name = new_name_of(module.__name__)
        assert new_name is not None
        warnings.warn(
            f"{module.__name__} is now {new_name}: import it from there.",
            DeprecationWarning,
            stacklevel=2,
        )
        sys.modules[module.__name__] = importlib.import_module(new_name)

    def is_package(self, fullname: str) -> bool:
        return self._new_spec(fullname).submodule_search_locations is not None

    def get_code(self, fullname: str) -> CodeType | None:
        """The code that ``python -m`` runs."""
        loader = self._new_spec(fullname).loader
        assert isinstance(loader, InspectLoader)
        return loader.get_code(fullname=self._new_spec(fullname).name)

    def get_source(self, fullname: str) -> str | None:
        loader = self._new_spec(fullname).loader
        assert isinstance(loader, InspectLoader)
        return loader.get_source(self._new_spec(fullname).name)

    def _new_spec(self, fullname: str) -> ModuleSpec:
        new_name = new_name_of(fullname)
        spec = importlib.util.find_spec(new_name) if new_name else None
        if spec is None:
            raise ImportError(f"No module named {fullname!r}", name=fullname)
        return spec


def new_name_of(fullname: str) -> str | None:
    """The present name of a module that has moved, or None.

    >>> new_name_of("sb3_policyflow.zoo.samplers")
    'sb3_policyflow.integrations.rl_zoo3.samplers'
    """
    parts = fullname.removeprefix(_ROOT).split(".") if fullname.startswith(_ROOT) else []
    for end in range(len(parts), 0, -1):
        new = MOVED.get(".".join(parts[:end]))
        if new is not None:
            return _ROOT + ".".join([new, *parts[end:]])
    return None


def install() -> None:
    """Let old names be imported, once."""
    if not any(isinstance(finder, MovedModules) for finder in sys.meta_path):
        # Before the other finders: in a package that has moved they would find a module by its
        # file, and load it a second time under its old name.
        sys.meta_path.insert(0, MovedModules())
