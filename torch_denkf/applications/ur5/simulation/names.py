"""Names of the UR5 table's tasks and domains, and its time step."""

from __future__ import annotations

from typing import Literal

__all__ = ["CONTROL_STEP", "DOMAIN_NAMES", "TASKS", "DomainName", "TaskName"]

TaskName = Literal["pick", "push", "put_down"]
DomainName = Literal["sim", "real_like"]

TASKS: tuple[TaskName, ...] = ("pick", "push", "put_down")
DOMAIN_NAMES: tuple[DomainName, ...] = ("sim", "real_like")
CONTROL_STEP = 0.08  # s between two rows
