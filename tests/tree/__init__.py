"""Tests of rosafe.tree: tokens, requests, changes, windows."""
