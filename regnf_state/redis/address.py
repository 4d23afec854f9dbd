"""Where Redis is, with the password from a file, so that it is in no environment and in no process' arguments."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote, urlsplit, urlunsplit

from regnf_core.texts import TextError, decode_text
from regnf_state.settings import Settings


class NoRedisError(RuntimeError):
    """The settings name no Redis."""

    reason = "REDIS_URL_MISSING"


class RedisPasswordError(NoRedisError):
    """The file of the password cannot be read."""

    reason = "REDIS_PASSWORD_UNREADABLE"


def redis_address(settings: Settings) -> str:
    """The address to connect to. Raises NoRedisError, RedisPasswordError."""
    if settings.redis_url is None:
        raise NoRedisError("set REGNF_REDIS_URL, or start with `regnf serve`, which brings its own Redis")
    if settings.redis_password_file is None:
        return settings.redis_url
    return _with_password(settings.redis_url, _password(settings.redis_password_file))


def _password(file: Path) -> str:
    try:
        password = decode_text(file.read_bytes()).strip()
    except OSError as error:
        raise RedisPasswordError(f"the file {file} cannot be read: {error.strerror}") from error
    except TextError as error:
        raise RedisPasswordError(f"the file {file} is {error}") from error
    if not password:
        raise RedisPasswordError(f"the file {file} is empty")
    return password


def _with_password(url: str, password: str) -> str:
    """The address with this password in place of its own."""
    parts = urlsplit(url)
    user, _, host = parts.netloc.rpartition("@")
    name = user.partition(":")[0]
    return urlunsplit(parts._replace(netloc=f"{name}:{quote(password, safe='')}@{host}"))
