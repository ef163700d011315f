"""Builds the servers of a Tower and the access control of its MLflow: ``make setup`` installs them in the checkout."""

from setuptools import setup

setup(
    name='shadowhound_tower',
    version='0.1.0',
    description='A Tower without Docker: SeaweedFS, MLflow and their access control.',
    license='Apache-2.0',
    packages=['shadowhound_tower'],
    zip_safe=False,
    python_requires='>=3.10',
)
