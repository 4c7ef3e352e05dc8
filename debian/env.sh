# Sourced by a shell: puts the ROS packages and the MATLAB and Octave classes of rosAFE on the paths, and sets
# ROS_MASTER_URI and ROS_IP to loopback if they are unset.
# shellcheck shell=sh
eval "$(/usr/bin/python3 -P -m rosafe.ros1.component.generate --shell)"
