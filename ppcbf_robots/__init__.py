"""Passivity-preserving neural control barrier functions for torque-controlled arms."""
__version__ = "0.1.0"
