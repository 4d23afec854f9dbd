"""The service's settings as a command reads them: the environment, and what was given on the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from regnf_core.errors import InvalidInputError

if TYPE_CHECKING:
    from regnf_state.settings import Settings

_HINT = "Correct the environment variable, or unset it to use the default."
_REDIS_SCHEMES = ("redis", "rediss", "unix")


def read_settings(**given: Any) -> Settings:
    """The settings; what is None is read from REGNF_* in the environment.

    Raises InvalidInputError (INVALID_SETTINGS) naming the first faulty setting, never its value: it may be a token.
    """
    from pydantic import ValidationError
    from pydantic_settings import SettingsError

    from regnf_state.settings import Settings

    try:
        settings = Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        message = f"REGNF_{where.upper()}: {first['msg'].removeprefix('Value error, ')}"
        raise InvalidInputError(message, reason="INVALID_SETTINGS", hint=_HINT) from error
    except SettingsError as error:
        raise InvalidInputError(str(error), reason="INVALID_SETTINGS", hint=_HINT) from error
    if settings.redis_url is not None:
        check_redis_url(settings.redis_url, "REGNF_REDIS_URL")
    return settings


def check_redis_url(url: str, name: str) -> None:
    """Raises InvalidInputError (INVALID_SETTINGS) naming the setting, never its value: it may hold a password."""
    if urlsplit(url).scheme not in _REDIS_SCHEMES:
        message = f"{name}: no address of a Redis, expected redis://, rediss:// or unix://"
        raise InvalidInputError(message, reason="INVALID_SETTINGS", hint="Write for example redis://127.0.0.1:6379/0.")
