"""The service's settings as a command reads them: the environment, and what was given on the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from regnf_core.errors import InvalidInputError

if TYPE_CHECKING:
    from regnf_state.settings import Settings


def read_settings(**given: Any) -> Settings:
    """The settings; what is None is read from REGNF_* in the environment.

    Raises InvalidInputError (INVALID_SETTINGS) naming the first faulty setting, never its value: it may be a token.
    """
    from pydantic import ValidationError
    from pydantic_settings import SettingsError

    from regnf_state.settings import Settings

    try:
        return Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InvalidInputError(f"REGNF_{where.upper()}: {first['msg']}", reason="INVALID_SETTINGS") from error
    except SettingsError as error:
        raise InvalidInputError(str(error), reason="INVALID_SETTINGS") from error
