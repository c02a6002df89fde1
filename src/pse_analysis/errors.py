"""Errors that a user can mend: each says what was expected, what came and what to do next."""

from __future__ import annotations


class PseError(Exception):
    """Base of them all; the command line prints these without a traceback."""


class ParameterError(PseError, ValueError):
    """A case file has a key or a value that nothing can use."""


class TableError(PseError, ValueError):
    """A table does not have the columns, types, units or names that its schema asks for."""


class DamagedFile(TableError):
    """A file is not as it was written: cut short, damaged, or changed by somebody else."""


class GridError(PseError, ValueError):
    """A grid model is inconsistent, or an element is not in it."""


class NotConverged(PseError, ArithmeticError):
    """An iteration ended without a solution."""


class Unobservable(PseError, ArithmeticError):
    """The measurements do not determine the state."""
