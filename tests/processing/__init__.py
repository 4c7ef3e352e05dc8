"""Tests of rosafe.process."""
