"""Online identification of a flexible arm and of the payload it holds."""

__version__ = '0.1.0'
