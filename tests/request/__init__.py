"""Tests of the request for a whole tree, on a tree in this process: rosafe.request and rosafe.genomix.trees."""
