"""ROS side of rosAFE: components, message generation, wire codecs and the node; may import rospy."""
