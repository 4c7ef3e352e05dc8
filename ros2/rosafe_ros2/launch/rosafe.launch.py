"""Start the node: ros2 launch rosafe_ros2 rosafe.launch.py device:=plughw:1,0 localize:=true."""

from typing import List

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    'device': (str, 'sound: plughw:1,0, file:take.wav, scene: or topic:/audio; empty: none'),
    'sample_rate': (int, 'sample rate in Hz; 0: that of the source, otherwise 44100'),
    'frames_per_block': (int, 'audio frames that are processed at a time'),
    'setup': (str, 'setup file to load; those of ROS 1 work, too'),
    'representations': (List[str], 'representations to compute, such as "[ild, ratemap]"'),
    'localize': (bool, 'track the directions of sources'),
    'head': (str, 'head of the localizer: SOFA file, learned model, pair:METRES or sphere'),
    'world_frame': (str, 'coordinate frame of the directions, from tf; empty: that of the head'),
    'frame_id': (str, 'coordinate frame of the head'),
    'speech_only': (bool, 'only sources that speak have poses'),
    'keep': (str, 'file in which the node stores its tree, to restore it at the next start'),
    'use_sim_time': (bool, 'use the time of /clock'),
}


def nodes(context):
    """Return the node with the arguments that were given; the others have the node's defaults."""
    given = context.launch_configurations
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (kind, _) in ARGUMENTS.items() if given[name]
    }
    return [Node(
        package='rosafe_ros2', executable='rosafe', name='rosafe', namespace=given['namespace'],
        parameters=[parameters], output='screen')]


def generate_launch_description():
    """Return the arguments and the node."""
    texts = {name: text for name, (_, text) in ARGUMENTS.items()}
    texts['namespace'] = 'namespace of the node'
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value='', description=text)
          for name, text in texts.items()),
        OpaqueFunction(function=nodes),
    ])
