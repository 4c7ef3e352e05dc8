"""Tests of eltclsh and elwish."""
