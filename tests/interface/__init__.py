"""Tests of rosafe.interface."""
