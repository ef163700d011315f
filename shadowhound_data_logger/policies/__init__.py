"""Policies: trained models that robots run. MLflow's registry selects the version; its files come from the store.

A robot runs a version only if it is signed and passes a smoke run on the robot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shadowhound_data_logger.policies.running import ActivePolicy, active

__all__ = ['ActivePolicy', 'active']


def __getattr__(name: str) -> Any:
    if name in __all__:  # imported when used: `status` reads only the folder
        from shadowhound_data_logger.policies import running  # noqa: PLC0415

        return getattr(running, name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
