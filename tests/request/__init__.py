"""Tests of the request for a whole tree, on a tree in this process: rosafe.tree.requests and rosafe.tree.building."""
