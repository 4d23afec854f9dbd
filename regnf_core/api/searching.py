"""``search`` as users call it: which of several objects a detection shows."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from regnf_core.api.fields import FieldLike, opened
from regnf_core.api.registered import Registered
from regnf_core.api.registering import box_of
from regnf_core.detections.objects import BoxLike
from regnf_core.errors import InvalidInputError, NoSurfaceError
from regnf_core.field_source import FieldSource, Role, find_source
from regnf_core.fields.base import SdfField
from regnf_core.library import Candidate, LibraryObject, model_object, search_library
from regnf_core.library_files import library_files
from regnf_core.loading import import_smallest_first, load_field
from regnf_core.object_models import object_model
from regnf_core.options import OptionsLike, RobustOptions, options_of, seed_of
from regnf_core.result import ProgressCallback

Objects = str | Path | Sequence[FieldLike | LibraryObject] | Mapping[str, FieldLike]
"""A folder of fields, a list of fields or their paths, or fields by names of your own."""


@dataclass(frozen=True)
class Search:
    """ranking: every object, the likeliest first · unusable: those without a surface, and why · result: the
    registration of the first."""

    ranking: list[Candidate]
    result: Registered
    unusable: dict[str, str]

    def __repr__(self) -> str:
        return f"<{self.ranking[0].name} of {len(self.ranking)} objects, {self.result!r}>"


def search(
    scene: FieldLike,
    objects: Objects,
    detection: BoxLike,
    options: OptionsLike = None,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    clouds: bool = True,
) -> Search:
    """Which object stands in the box, and where, by the preset `robust`.

    An object's model is made once and kept in the user's cache, for objects that are given by their paths. Other
    arguments as of ``register``. Raises InvalidInputError (LIBRARY_EMPTY), InvalidOptionsError
    (LIBRARY_SEARCH_UNSUPPORTED), NoSurfaceError, and what ``register`` raises.
    """
    chosen, box, seed = options_of(options), box_of(detection), seed_of(seed)
    chosen.require_robust("searches a library", reason="LIBRARY_SEARCH_UNSUPPORTED")
    named = _named(objects)
    given: list[tuple[FieldLike | LibraryObject, Role]] = [
        (scene, "scene"),
        *((one, "object") for one in named.values()),
    ]
    import_smallest_first(
        find_source(Path(one), role=role) for one, role in given if isinstance(one, str | os.PathLike)
    )
    place = opened(scene, "scene")
    library, unusable = [], {}
    for name, one in named.items():
        try:
            library.append(_modeled(name, one, chosen.robust))
        except NoSurfaceError as error:
            unusable[name] = error.reason
    if not library:
        raise NoSurfaceError("none of the objects has a surface", reason="NO_SURFACE_IN_OBJECT")
    found = search_library(place.field, box, library, chosen, seed, progress, clouds)
    first = found.ranking[0].name
    notes = None if place.notes is None else {"scene": place.notes}
    return Search(found.ranking, Registered.of(found.result, first, notes, box), unusable)


def _named(objects: Objects) -> dict[str, FieldLike | LibraryObject]:
    """The objects by their names. Raises InvalidInputError (LIBRARY_EMPTY, LIBRARY_TOO_LARGE, NO_FIELD)."""
    if isinstance(objects, str | os.PathLike):
        return {str(path): path for path in library_files([Path(objects)])}
    if isinstance(objects, Mapping):
        named: dict[str, FieldLike | LibraryObject] = dict(objects)
    elif isinstance(objects, Sequence):
        named = {_name(one, number): one for number, one in enumerate(objects)}
    else:
        hint = "Give a folder, a list of fields or paths, or a dictionary of them by name."
        raise InvalidInputError(f"the objects are a {type(objects).__name__}", reason="NO_FIELD", hint=hint)
    if not named:
        raise InvalidInputError("the library has no objects", reason="LIBRARY_EMPTY", hint="Give at least one object.")
    return named


def _name(one: FieldLike | LibraryObject, number: int) -> str:
    if isinstance(one, LibraryObject):
        return one.name
    return str(one) if isinstance(one, str | os.PathLike) else f"object {number}"


def _modeled(name: str, one: FieldLike | LibraryObject, options: RobustOptions) -> LibraryObject:
    if isinstance(one, LibraryObject):
        return one
    if isinstance(one, str | os.PathLike):
        source = find_source(Path(one), role="object")
        return LibraryObject(name, partial(_field_of, source), object_model(source, options))
    field = opened(one, "object").field
    return LibraryObject(name, lambda: field, model_object(field, options))


def _field_of(source: FieldSource) -> SdfField:
    return load_field(source).field
