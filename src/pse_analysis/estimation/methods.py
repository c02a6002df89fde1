"""What a method of a case file is, and how a name in a case file finds its kind.

A kind of method is a frozen dataclass that holds what a case file may say of it and builds the
estimator. The decorator `named` gives it the name that a case file uses; installed packages offer
kinds of their own as entry points of the group ``pse_analysis.estimators``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from importlib import metadata
from typing import Any, ClassVar, Literal, TypeVar

from pse_analysis import parameters
from pse_analysis.errors import ParameterError
from pse_analysis.estimation.bad_data import adaptive_threshold
from pse_analysis.estimation.core.interface import Estimator
from pse_analysis.estimation.core.snapshots import Record
from pse_analysis.grid.network import Network
from pse_analysis.measurement import Model, SensorLayout
from pse_analysis.parameters import Study
from pse_analysis.validation.adaptive import AdaptiveParams

GROUP = "pse_analysis.estimators"
"""Entry points by which installed packages offer methods."""
THRESHOLDS = ("literal", "absolute", "scaled")
"""Kinds of the adaptive threshold."""

KINDS: dict[str, type[Method]] = {}
"""Methods of this package by the name that a case file gives."""


@dataclass(frozen=True, eq=False)
class Setting:
    """What an estimator is built for.

    Attributes
    ----------
    model : Network or Machine
    layout : SensorLayout
        The channels, in the order in which snapshots have them.
    study : Study
    history : Record
        Aligned telemetry before the study.
    """

    model: Model
    layout: SensorLayout
    study: Study
    history: Record

    @property
    def network(self) -> Network:
        """The grid.

        Raises
        ------
        ParameterError
            If the case is about a machine.
        """
        if isinstance(self.model, Network):
            return self.model
        raise ParameterError(
            f"this method estimates a grid, but the case is about {self.model.element}: use "
            'filter = "observer"'
        )


@dataclass(frozen=True, kw_only=True)
class Method:
    """A method of a case file; each kind has a class of its own, which adds its parameters.

    Attributes
    ----------
    name : str
        Spelling in tables and figures.
    filter : str
        Names the kind.
    variant : str
        The aligned variant it reads.
    """

    about: ClassVar[str] = "grid"
    """Whether it estimates a ``grid`` or a ``machine``."""

    name: str
    filter: str
    variant: str = "last"

    def __post_init__(self) -> None:
        if not self.name.strip():
            raise ParameterError("[estimate.methods] name is empty: give each method its own")
        for key, needed in self.without_effect():
            raise ParameterError(
                f"[estimate.methods] {self.name!r}: {key} has no effect here: drop it, or {needed}"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names by which it stands in tables: its own, and those of its variants if it has any."""
        return (self.name,)

    @staticmethod
    def of(name: str, filter: str, **given: Any) -> Method:
        """Method of a kind with some of its parameters, as a case file would give them.

        Parameters
        ----------
        name, filter : str
        **given
            Keys of the kind; tables may be dataclasses or mappings.

        Raises
        ------
        ParameterError
            If the kind or a key of it is unknown, or a value is out of its range.
        """
        data = {"name": name, "filter": filter, **given}
        return parameters.build(Method, data, "estimate.methods")

    @classmethod
    def chosen(cls, data: Mapping[str, Any], where: str) -> type[Method]:
        """Class of the method that a table describes; called by `pse_analysis.parameters.build`."""
        if cls is not Method:
            return cls
        if not isinstance(data.get("filter"), str):
            raise ParameterError(
                f"[{where}] key 'filter' is missing: expected one of "
                f"{', '.join(map(repr, KINDS))}, received {data.get('filter')!r}"
            )
        found = kind(data["filter"], where)
        own = {one.name for one in fields(found)}
        for key in data:
            owners = [
                name for name, other in KINDS.items() if key in (one.name for one in fields(other))
            ]
            if key not in own and owners:
                raise ParameterError(
                    f"[{where}] {key} has no effect with filter = {data['filter']!r}: drop it, or "
                    f"take filter = {spelt(owners)}"
                )
        return found

    def without_effect(self) -> Iterator[tuple[str, str]]:
        """Keys that are given in vain, each with what it needs."""
        yield from ()

    def estimator(self, setting: Setting) -> Estimator:
        """Estimator of this method for a grid or machine; every kind has its own.

        Raises
        ------
        ParameterError
            If the parameters do not suit the model or what is known of it.
        """
        raise NotImplementedError(f"{type(self).__name__} has no estimator")


@dataclass(frozen=True, kw_only=True)
class GridMethod(Method):
    """A method for grids, behind an adaptive threshold if one is asked for.

    Attributes
    ----------
    screening : {"none", "literal", "absolute", "scaled", "innovation"}
        How gross errors are met: by an adaptive threshold before any method, or by a filter's own
        innovation.
    adaptive_threshold : AdaptiveParams, optional
        Numbers of the threshold; its kind is that of ``screening``.
    """

    screening: Literal["none", "literal", "absolute", "scaled", "innovation"] = "none"
    adaptive_threshold: AdaptiveParams | None = None

    def without_effect(self) -> Iterator[tuple[str, str]]:
        numbers = self.adaptive_threshold
        if numbers is not None and self.screening not in THRESHOLDS:
            yield "adaptive_threshold", f"take screening = {spelt(THRESHOLDS)}"
        if numbers is not None and numbers.threshold != AdaptiveParams().threshold:
            yield "adaptive_threshold.threshold", "say it as screening"

    def estimator(self, setting: Setting) -> Estimator:
        plain = self.unscreened(setting)
        if self.screening == "none" or self.screening == "innovation":
            return plain
        numbers = replace(self.adaptive_threshold or AdaptiveParams(), threshold=self.screening)
        return adaptive_threshold.screened(plain, setting.layout, numbers, setting.history)

    def unscreened(self, setting: Setting) -> Estimator:
        """The estimator without an adaptive threshold."""
        raise NotImplementedError(f"{type(self).__name__} has no estimator")


@dataclass(frozen=True)
class EstimateParams:
    """The methods of a case, compared on the same telemetry."""

    methods: tuple[Method, ...]


Kind = TypeVar("Kind", bound=type[Method])


def named(name: str) -> Callable[[Kind], Kind]:
    """Decorator that gives a kind of method the name by which case files find it."""

    def add(found: Kind) -> Kind:
        KINDS[name] = found
        return found

    return add


def spelt(names: Iterable[str]) -> str:
    """Values of a key as a case file spells them: ``"a" or "b"``."""
    return " or ".join(f'"{name}"' for name in names)


def kind(name: str, where: str = "estimate.methods") -> type[Method]:
    """Class of parameters that a name in a case file stands for.

    Parameters
    ----------
    name : str
        Of this package or of an entry point ``pse_analysis.estimators`` of an installed one.
    where : str
        Table of the case file, for messages.

    Raises
    ------
    ParameterError
        If nothing has the name, or an installed package does not keep what it promises.
    """
    if name in KINDS:
        return KINDS[name]
    offered = {point.name: point for point in metadata.entry_points(group=GROUP)}
    if name not in offered:
        raise ParameterError(
            f"[{where}] filter must be one of {', '.join(map(repr, (*KINDS, *offered)))}, received "
            f"{parameters.brief(name)}; a method of your own is an entry point of the group "
            f"{GROUP!r} in an installed package"
        )
    point = offered[name]
    try:
        found = point.load()
    except Exception as error:
        raise ParameterError(
            f"[{where}] filter = {name!r} is {point.value!r} of an installed package, which cannot "
            f"be loaded ({type(error).__name__}: {error}): install it again, or take another method"
        ) from error
    if not (isinstance(found, type) and issubclass(found, Method)):
        raise ParameterError(
            f"[{where}] filter = {name!r} is {point.value!r} of an installed package, which is no "
            "subclass of pse_analysis.estimation.Method"
        )
    return found


Factory = Callable[[Setting], Estimator]
"""Makes an estimator of one's own."""
