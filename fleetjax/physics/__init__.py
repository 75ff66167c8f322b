"""Rigid-body physics of robots: one contract, several backends."""
