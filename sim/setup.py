"""Builds the simulated robots and the demo. They are not in the robot's wheel: ``make setup`` installs them in the checkout."""

from setuptools import setup

setup(
    name='shadowhound_sim',
    version='0.1.0',
    description='Simulated robots and the demo of shadowhound_data_logger.',
    license='Apache-2.0',
    packages=['shadowhound_sim'],
    zip_safe=False,
    python_requires='>=3.10',
    entry_points={'console_scripts': ['sim_go2_node = shadowhound_sim.sim_go2_node:main']},
)
