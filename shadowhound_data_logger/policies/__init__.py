"""Policies: trained models on their way to the robot; which one by MLflow's registry, bytes from the store.

Whether one may run is said by a signature and by what it does on this machine.
"""

from shadowhound_data_logger.policies.running import ActivePolicy, active

__all__ = ['ActivePolicy', 'active']
