"""Install the node with the Python package rosafe, to which a link in this folder leads."""

from xml.etree import ElementTree

from setuptools import find_namespace_packages, setup

NAME = 'rosafe_ros2'

setup(
    name=NAME,
    version=ElementTree.parse('package.xml').findtext('version'),
    description='The Two!Ears auditory front-end as a ROS 2 node',
    license='BSD-3-Clause',
    packages=find_namespace_packages(include=['rosafe', 'rosafe.*']),
    package_data={'': ['*']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/launch', ['launch/rosafe.launch.py']),
    ],
    zip_safe=False,
    entry_points={'console_scripts': ['rosafe = rosafe.ros2.node:run']},
)
