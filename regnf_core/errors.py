"""Every error regnf raises on purpose, each with a stable ``reason`` that programs may switch on.

    RegnfError
    ├── InvalidInputError            the caller can mend it
    │   ├── InvalidOptionsError      INVALID_OPTIONS, INITIAL_TRANSFORM_UNSUPPORTED, LIBRARY_SEARCH_UNSUPPORTED
    │   ├── InvalidDetectionError    INVALID_DETECTION, DETECTION_OUTSIDE_SCENE
    │   ├── FieldFormatError         the bytes are no field we take: the reason says which stage refused them
    │   └── DatasetError             DATASET_...: a folder of posed images, or what one is rendered from, cannot be used
    ├── NoSurfaceError               NO_SURFACE_IN_DETECTION, NO_SURFACE_IN_OBJECT
    ├── InitializationError          NO_INITIAL_TRANSFORM
    ├── FitDivergedError             FIT_DIVERGED
    ├── MissingExtraError            EXTRA_MISSING
    └── CancelledError               CANCELLED

This module imports nothing heavy: the HTTP front end uses it without loading torch.
"""

from __future__ import annotations

from collections.abc import Sequence

from regnf_core.field_candidates import Candidate, Said
from regnf_core.hints import hint_of


class RegnfError(Exception):
    """Base of all errors raised by regnf.

    ``reason`` is a stable UPPER_SNAKE word; the message is for people and may change. ``hint`` says what to do next:
    the one given, else the usual one for the reason, else None.
    """

    reason: str = "INTERNAL"

    def __init__(self, message: str, *, reason: str | None = None, hint: str | None = None) -> None:
        super().__init__(message)
        if reason is not None:
            self.reason = reason
        self._hint = hint

    @property
    def hint(self) -> str | None:
        return self._hint or hint_of(self.reason)


class InvalidInputError(RegnfError):
    """Something the caller gave cannot be used."""

    reason = "INVALID_INPUT"


class InvalidOptionsError(InvalidInputError):
    """An option is unknown, of the wrong type or out of its range."""

    reason = "INVALID_OPTIONS"


class InvalidDetectionError(InvalidInputError):
    """A detection box is malformed, or lies outside the scene's bounds.

    ``place`` leads to the faulty member from the detection on: ("center", 0).
    """

    reason = "INVALID_DETECTION"

    def __init__(
        self, message: str, *, reason: str | None = None, hint: str | None = None, place: tuple[str | int, ...] = ()
    ) -> None:
        super().__init__(message, reason=reason, hint=hint)
        self.place = place


class FieldFormatError(InvalidInputError):
    """The bytes do not hold a field that regnf can take. ``reason`` tells the stage and the fault.

    candidates: the functions that a file may stand for, where that is why (LAYOUT_AMBIGUOUS). said: what the user
    said of the field, where that is known.
    """

    reason = "FIELD_NOT_RECOGNIZED"
    said: Said | None = None

    def __init__(
        self,
        message: str,
        *,
        reason: str | None = None,
        hint: str | None = None,
        candidates: Sequence[Candidate] = (),
    ) -> None:
        super().__init__(message, reason=reason, hint=hint)
        self.candidates = tuple(candidates)

    def told(self, message: str, hint: str | None = None) -> FieldFormatError:
        """The same error in other words."""
        error = FieldFormatError(message, reason=self.reason, hint=hint or self.hint, candidates=self.candidates)
        error.said = self.said
        return error


class DatasetError(InvalidInputError):
    """A folder of posed images cannot be read or written, or a scene cannot be rendered. ``reason`` tells the fault."""

    reason = "DATASET_INVALID"


class NoSurfaceError(RegnfError):
    """Too few surface points were found where the object should be."""

    reason = "NO_SURFACE_IN_DETECTION"


class InitializationError(RegnfError):
    """No initial transform could be estimated from the surface points."""

    reason = "NO_INITIAL_TRANSFORM"


class FitDivergedError(RegnfError):
    """A field that is being fitted is no longer made of numbers; its last checkpoint is kept."""

    reason = "FIT_DIVERGED"


class CancelledError(RegnfError):
    """The caller asked for the work to stop."""

    reason = "CANCELLED"


class MissingExtraError(RegnfError):
    """An extra of the package that is needed is not installed, or only in part."""

    unavailable = True
    reason = "EXTRA_MISSING"

    @classmethod
    def of(cls, modules: Sequence[str], extras: Sequence[str]) -> MissingExtraError:
        """Names the modules that are not there, and the extras that bring them."""
        return cls(f"not installed: {', '.join(modules)}; pip install 'regnf[{','.join(extras)}]'")
