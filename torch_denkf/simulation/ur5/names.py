"""Names of the UR5 table's tasks, and of the places where it stands."""

from __future__ import annotations

from typing import Literal

__all__ = ["DOMAIN_NAMES", "TASKS", "DomainName", "TaskName"]

TaskName = Literal["pick", "push", "put_down"]
DomainName = Literal["sim", "real_like"]

TASKS: tuple[TaskName, ...] = ("pick", "push", "put_down")
DOMAIN_NAMES: tuple[DomainName, ...] = ("sim", "real_like")
