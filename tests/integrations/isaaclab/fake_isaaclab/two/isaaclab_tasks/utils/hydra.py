"""Configurations of version 2: a decorator that reads the command line."""

import sys
from collections.abc import Callable
from typing import Any

import fake_lab


def hydra_task_config(task_name: str, agent_cfg_entry_point: str) -> Callable[..., Any]:
    def decorator(function: Callable[..., None]) -> Callable[[], None]:
        def wrapper() -> None:
            function(
                *fake_lab.override(fake_lab.load(task_name, agent_cfg_entry_point), sys.argv[1:])
            )

        return wrapper

    return decorator
