"""The ament_python package: what is installed where, and the names `ros2 run` knows.

The same file makes the wheel that needs no ROS: there the names are ordinary console scripts in bin/, and the shared
files lie in share/flexmanip_ros of the environment.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.develop import develop
from setuptools.command.install import install

NAME = 'flexmanip_ros'
HERE = Path(__file__).resolve().parent
NODES = (
    'plant_simulator', 'excitation', 'capture_trigger', 'rpbsid_identifier', 'payload_controller', 'payload_adapter',
)
# What the offline programs import; rosdep's names for the same are in package.xml.
LIBRARIES = ('numpy', 'scipy', 'numba>=0.59', 'matplotlib', 'PyYAML', 'rich', 'rosbags', 'lz4',
             'backports.zstd; python_version < "3.14"',
             'scikit-fem')  # reproduce_paper alone; it has no rosdep key
# rclpy and the messages as wheels (Linux x86-64); nobody needs them who has sourced a ROS installation.
ROS = ('ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-diagnostic-msgs', 'ros-jazzy-geometry-msgs',
       'ros-jazzy-sensor-msgs', 'ros-jazzy-std-msgs', 'ros-jazzy-std-srvs', 'ros-jazzy-visualization-msgs')
PROGRAMS = ('identify_bag', 'simulate_bag', 'live_view', 'reproduce_paper', 'monte_carlo', 'write_urdf')


def share_files() -> list[tuple[str, list[str]]]:
    """Return (target folder, files) for everything `ros2 launch` and `ros2 pkg` look up."""
    share = Path('share') / NAME
    targets = {
        Path('share/ament_index/resource_index/packages'): [Path('resource') / NAME],
        share: [Path('package.xml')],
    }
    for folder in ('config', 'launch'):
        for path in sorted((HERE / folder).rglob('*')):
            if path.is_file() and '__pycache__' not in path.parts:
                relative = path.relative_to(HERE)
                targets.setdefault(share / relative.parent, []).append(relative)
    return [(str(target), [str(path) for path in paths]) for target, paths in targets.items()]


def compile_kernels(where: str) -> None:
    """Fill the compiled cache of the package in ``where``, so that the first sample meets no compiler.

    Only a matter of speed: whatever goes wrong here, the kernels compile at first use instead.
    """
    if os.environ.get('FLEXMANIP_WARM_UP', '1') == '0':
        return
    path = os.pathsep.join(part for part in (where, os.environ.get('PYTHONPATH')) if part)
    command = [sys.executable, '-m', f'{NAME}.cli.warm_up']
    try:
        subprocess.run(command, env={**os.environ, 'PYTHONPATH': path}, cwd=where, timeout=600, check=False,
                       stdin=subprocess.DEVNULL)
    except (OSError, subprocess.SubprocessError) as problem:
        print(f'{NAME}: the kernels compile at first use: {problem}')


class InstallAndCompile(install):
    """`colcon build`: the cache belongs to the installed files, so it is filled after them."""

    def run(self) -> None:
        """Install, then compile unless this only stages files for a package."""
        super().run()
        if self.root is None and self.install_lib is not None:
            compile_kernels(os.path.abspath(self.install_lib))


class DevelopAndCompile(develop):
    """`colcon build --symlink-install`: the sources stay where they are, and so does their cache."""

    def run(self) -> None:
        """Link, then compile unless the link is being taken away."""
        super().run()
        if not self.uninstall:
            compile_kernels(str(HERE))


setup(
    name=NAME,
    version='0.1.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', 'view/page.html']},
    data_files=share_files(),
    install_requires=list(LIBRARIES),
    maintainer='flexmanip_ros maintainers',
    maintainer_email='maintainers@flexmanip-ros.example',
    python_requires='>=3.11',
    extras_require={
        'ros': list(ROS),
        'test': ['pytest', 'pytest-timeout', 'hypothesis'],
        'cluster': ['dask', 'distributed'],
    },
    zip_safe=False,
    cmdclass={'install': InstallAndCompile, 'develop': DevelopAndCompile},
    description='Online identification of a flexible two-link arm and of the payload it catches.',
    long_description=(HERE / 'README.md').read_text(encoding='utf-8'),
    long_description_content_type='text/markdown',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            *(f'{name} = {NAME}.ros.nodes.{name}:main' for name in NODES),
            f'demo = {NAME}.ros.demo:main',
            *(f'{name} = {NAME}.cli.{name}:main' for name in PROGRAMS),
        ],
    },
)
