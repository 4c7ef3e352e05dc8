"""Tests of the request for a whole tree, without ROS: rosafe.tree.tree_planner and rosafe.tree.tree_builder."""
