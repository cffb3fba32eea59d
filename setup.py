"""Build of the ROS package: every node and every offline tool is one executable."""

import runpy
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

PACKAGE = 'anser_ros'
HERE = Path(__file__).parent
# Read without importing the package, whose dependencies may not be installed yet.
COMMANDS = runpy.run_path(str(HERE / PACKAGE / 'cli' / 'commands.py'))
VERSION = ElementTree.parse(HERE / 'package.xml').findtext('version')


def shared(*folders):
    """Yield the data_files entries of the folders that are installed under share/."""
    for folder in folders:
        files = sorted(path for path in (HERE / folder).glob('*') if path.is_file())
        if files:
            yield f'share/{PACKAGE}/{folder}', [str(path.relative_to(HERE)) for path in files]


names = [name for group in ('NODES', 'COMPOSED', 'OFFLINE') for name in COMMANDS[group]]
scripts = [f'{name} = {PACKAGE}.cli.main:run_executable' for name in names]

setup(
    name=PACKAGE,
    version=VERSION,
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={PACKAGE: ['py.typed'], f'{PACKAGE}.apps.dashboard': ['*.js', '*.css']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        *shared('config', 'launch', 'bags'),
    ],
    install_requires=[
        'setuptools',
        'numpy>=1.26',
        'pandas>=2.1',
        'scipy>=1.11',
        'h5py>=3.10',
        'numba>=0.59',
        'PyYAML>=6',
        'pyserial>=3.5',
        'mcap>=1.5',
        'mcap-ros2-support>=0.5.5',
        'zstandard>=0.22',
        'rich>=13',
        'matplotlib>=3.8',
        'allantools>=2024.6',
    ],
    extras_require={
        'dashboard': ['nicegui>=3.0', 'fastapi>=0.110', 'uvicorn>=0.30'],
        'docs': ['sphinx>=9', 'myst-parser>=5', 'furo>=2025.9'],
    },
    python_requires='>=3.11',
    zip_safe=True,
    maintainer='anser_ros maintainers',
    maintainer_email='maintainers@anser-ros.invalid',
    description='Electromagnetic tracking with the Anser field generator on ROS 2',
    license='Apache-2.0',
    entry_points={'console_scripts': [f'anser = {PACKAGE}.cli.main:main', *scripts]},
)
