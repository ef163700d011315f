"""Builds the package for colcon (ament_python) and for pip. The version is also in package.xml; a test compares them."""

from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = 'shadowhound_data_logger'

setup(
    name=PACKAGE,
    version='0.1.0',
    description='Takes the sensor data of a ROS 2 robot off it: complete, verified, and accounted for.',
    long_description='A ROS 2 data logger that stores what it receives, or lists it with the reason why not.',
    author='ShadowHound maintainers',
    maintainer='ShadowHound maintainers',
    maintainer_email='maintainers@shadowhound.invalid',
    license='Apache-2.0',
    packages=find_packages(include=[PACKAGE, PACKAGE + '.*']),
    package_data={
        PACKAGE: [
            'py.typed',
            'spool/schema.sql',
            'live/page/*.*',
            'live/page/vendor/*.*',
            'formats/interfaces/*/msg/*.msg',
            'formats/interfaces/*/LICENSE',
        ]
    },
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + PACKAGE]),
        ('share/' + PACKAGE, ['package.xml']),
        ('share/bash-completion/completions', ['resource/completion/shadowhound-data']),
        ('share/' + PACKAGE + '/launch_configs', sorted(str(path) for path in Path('launch_configs').glob('*.*'))),
    ],
    zip_safe=False,
    python_requires='>=3.10',
    # The same as requirements/runtime.in, which has the reason for each.
    install_requires=[
        'aiohttp>=3.14.4',
        'backports-zstd>=1.0; python_version < "3.14"',
        'boto3>=1.36',
        'click>=8.1',
        'lz4>=4.0',
        'mcap>=1.1',
        'numpy>=1.21',
        'orjson>=3.11.6',
        'pillow>=12.3',
        'rich>=13',
        'rosbags>=0.11.9',
        'ruamel-yaml>=0.17',
        'simplejpeg>=1.8',
    ],
    extras_require={
        'datasets': ['av>=15', 'deltalake>=1.6,<2', 'h5py>=3.8', 'obstore>=0.11', 'pyarrow>=16'],
        'lake': ['deltalake>=1.6,<2', 'matplotlib>=3.6', 'obstore>=0.11', 'pyarrow>=16'],
        'policies': [
            'cryptography>=48',
            'onnx>=1.16',
            'onnxruntime>=1.17',
            'safetensors>=0.4.3',
            'securesystemslib>=1.6',
            'tuf>=7',
        ],
        'likeness': ['onnx>=1.16', 'onnxruntime>=1.17', 'tokenizers>=0.15'],
        'missions': ['matplotlib>=3.6', 'mlflow-skinny>=2.14'],
        'tower': ['grpcio>=1.66.2'],
        'train': ['mlflow-skinny>=2.14', 'torch>=2.6'],  # examples/train_navigation_policy.py; torch alone needs 200 MB and more
        'webrtc': ['aiortc>=1.15,<2', 'av>=15'],
        'test': ['pytest'],  # colcon runs pytest where a test extra names it
    },
    entry_points={
        'console_scripts': [
            'sensor_logger_node = shadowhound_data_logger.node.sensor_logger_node:main',
            'shadowhound-data = shadowhound_data_logger.cli.main:main',
        ],
    },
)
