"""Configurations of version 3: a function that is given what to change."""

from typing import Any

import fake_lab


def resolve_task_config(
    task_name: str,
    agent_cfg_entry_point: str,
    play_mode: bool = False,
    overrides: list[str] | None = None,
) -> tuple[Any, Any]:
    return fake_lab.override(fake_lab.load(task_name, agent_cfg_entry_point), overrides or [])
