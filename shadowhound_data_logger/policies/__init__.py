"""Policies: trained models on their way to the robot; which one by MLflow's registry, bytes from the store.

Whether one may run is said by a signature and by what it does on this machine.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from shadowhound_data_logger.policies.running import ActivePolicy, active

__all__ = ['ActivePolicy', 'active']


def __getattr__(name: str) -> Any:
    if name in __all__:  # imported when used: `status` looks at the folder alone
        from shadowhound_data_logger.policies import running  # noqa: PLC0415

        return getattr(running, name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
