"""Settings of API and worker: one frozen class, read from the environment with the prefix REGNF_."""

from __future__ import annotations

import ipaddress
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from pydantic import BaseModel, BeforeValidator, Field, ValidationError, model_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict, SettingsError

from regnf_core.errors import InvalidInputError
from regnf_core.texts import TextError, decode_text

MIB = 1024 * 1024
_RATE_BEYOND_LOOPBACK = 20.0


def _default_state_dir() -> Path:
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "regnf"


SECRETS = frozenset({"REGNF_API_TOKENS", "REGNF_WEBHOOK_SECRETS"})
"""Variables that only the API's process needs to see."""
_PREFIX = "REGNF_"
_AtLeastOne = Annotated[int, Field(ge=1)]
_Positive = Annotated[float, Field(gt=0)]
_NotNegative = Annotated[int, Field(ge=0)]
_Minutes = Annotated[int, Field(ge=60)]
_NotNegativeFloat = Annotated[float, Field(ge=0)]
_Kilobytes = Annotated[int, Field(ge=1024)]
_FIXED_VARIABLE = "REGNF_TEST_FIXED"
"""A JSON object of values of ``Fixed``, for tests and measurements that start processes."""
_RENAMED = {
    "REGNF_API_TOKENS_FILE": "REGNF_API_TOKENS=@/path/of/the/file",
    "REGNF_WEBHOOK_SECRETS_FILE": "REGNF_WEBHOOK_SECRETS=@/path/of/the/file",
    "REGNF_REDIS_PASSWORD_FILE": "REGNF_REDIS_PASSWORD=@/path/of/the/file",
    "REGNF_METRICS_HOST": "REGNF_METRICS_ADDRESS=host:port",
    "REGNF_METRICS_PORT": "REGNF_METRICS_ADDRESS=host:port",
    "REGNF_RATE_LIMIT_PER_S": "REGNF_QUOTA_CALLS_PER_S",
    "REGNF_RETENTION_S": "REGNF_JOB_RETENTION_S",
    "REGNF_UNUSED_FIELD_RETENTION_S": "REGNF_FIELD_RETENTION_S",
    "REGNF_STORAGE_CAP_BYTES": "REGNF_MAX_STORED_BYTES",
    "REGNF_CALLER_WEIGHTS": "REGNF_QUOTA_ACTIVE_JOBS",  # gone with the shares of worker time: callers take turns
    "REGNF_QUOTA_WORKER_SECONDS_PER_HOUR": "REGNF_QUOTA_ACTIVE_JOBS",
}


def address_of(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """The IP address that ``host`` is, an IPv4 address inside of IPv6 unpacked, no zone; None for a name."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return None
    return getattr(address, "ipv4_mapped", None) or address


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach the host. Names other than localhost are not looked up: they are not."""
    address = address_of(host)
    return host == "localhost" if address is None else address.is_loopback


def variables(**settings: object) -> dict[str, str]:
    """The environment that gives a process these settings, and these values of ``Fixed``."""
    fixed = {name: value for name, value in settings.items() if name in Fixed.model_fields}
    told = {f"{_PREFIX}{name.upper()}": str(value) for name, value in settings.items() if name not in fixed}
    return told | ({_FIXED_VARIABLE: json.dumps(fixed)} if fixed else {})


def _secret(given: object) -> object:
    """A secret, or `@` and the path of a file that holds it. Empty: none. Raises ValueError."""
    if not isinstance(given, str) or not given.startswith("@"):
        return given or None
    try:
        text = decode_text(Path(given[1:]).read_bytes()).strip()
    except OSError as error:
        raise ValueError(f"the file {given[1:]} cannot be read: {error.strerror}") from error
    except TextError as error:
        raise ValueError(f"the file {given[1:]} is {error}") from error
    if not text:
        raise ValueError(f"the file {given[1:]} is empty")
    return text


def _entries(given: object) -> object:
    """Secrets as a JSON list, or `@` and the path of a file with one a line, # before a comment. Raises ValueError."""
    if not isinstance(given, str):
        return given
    if not given.startswith("@"):
        try:
            return json.loads(given or "[]")
        except ValueError:
            raise ValueError("it is neither a JSON list nor @ with the path of a file") from None
    lines = [line.strip() for line in str(_secret(given)).splitlines()]
    entries = [line for line in lines if line and not line.startswith("#")]
    if not entries:
        raise ValueError(f"the file {given[1:]} holds no entry")
    return entries


class Fixed(BaseModel):
    """What no variable sets: nobody needs other values. Only tests and measurements give them."""

    max_request_bytes: _Kilobytes = 1 * MIB  # largest JSON body
    rate_limit_burst: _AtLeastOne = 100  # calls that a caller may make at once after a pause
    max_requests_per_caller: _AtLeastOne = 512
    """Requests of each caller that are in progress in one process; without tokens, of each address."""
    max_uploads_per_caller: int = Field(default=64, ge=2)
    max_streams_per_caller: _AtLeastOne = 100
    max_imports_per_caller: _AtLeastOne = 64  # imports of each caller that wait or run
    quota_batches: _AtLeastOne = 100
    """Of each caller; beyond this the one goes that was posted first of those that have ended."""
    max_batch_pairs: _AtLeastOne = 1000
    max_batch_bytes: _Kilobytes = 8 * MIB  # largest body of a batch
    max_finished_jobs: _AtLeastOne = 50_000
    """Of all callers; beyond this the oldest ones of the caller that has most go."""
    redis_reserve: float = Field(default=0.1, ge=0, le=0.5)
    """Share of Redis' memory that new jobs and fields must leave free."""
    heartbeat_s: _Positive = 5.0
    lost_after_s: _Positive = 90.0  # a running job whose heartbeat is older than this is lost
    keep_originals_s: _Minutes = 6 * 3600
    """How long an upload stays after its import, where ``keep_originals`` says that it does."""
    keep_originals_bytes: _NotNegative = 8192 * MIB  # of each caller; beyond this the oldest go
    keep_pieces_s: _Minutes = 24 * 3600  # how long an upload that came in pieces waits for the next one
    keep_pieces_bytes: _NotNegative = 8192 * MIB  # of each caller's unfinished uploads; beyond this the oldest go


class Settings(Fixed, BaseSettings):
    """Every setting has a default that works on one machine; each is REGNF_<NAME> in the environment.

    What each means is in docs/environment.md. `quota_*` is of each caller, `max_*` of all together, `job_*` of one
    registration, `import_*` of one import. Secrets are given as they are, or as `@` and the path of a file.
    """

    model_config = SettingsConfigDict(env_prefix=_PREFIX, frozen=True, extra="ignore", hide_input_in_errors=True)

    host: str = "127.0.0.1"
    port: int = Field(default=8080, ge=0, le=65535)
    state_dir: Path = Field(default_factory=_default_state_dir)
    demo_dir: Path | None = None  # of the demo's files, which the home page offers; `regnf serve` sets it
    redis_url: str | None = Field(default=None, repr=False)
    queue_key: Annotated[Annotated[str, Field(min_length=16)] | None, BeforeValidator(_secret)] = Field(
        default=None, repr=False
    )
    redis_password: Annotated[str | None, BeforeValidator(_secret)] = Field(default=None, repr=False)
    workers: int = Field(default=1, ge=0, le=64)
    device: Literal["auto", "cpu", "cuda"] = "auto"
    threads: int | None = Field(default=None, ge=1, le=256)
    preload: bool = sys.platform.startswith("linux")
    api_tokens: Annotated[frozenset[str], NoDecode, BeforeValidator(_entries)] = Field(default=frozenset(), repr=False)
    publish: str | None = None
    allowed_hosts: frozenset[str] = frozenset()
    behind_proxy: bool = False
    cors_origins: frozenset[str] = frozenset()
    allow_unauthenticated: bool = False
    max_upload_bytes: _AtLeastOne = 4096 * MIB
    max_queued_jobs: _AtLeastOne = 1000
    quota_calls_per_s: _NotNegativeFloat | None = None
    quota_active_jobs: _AtLeastOne | None = None
    quota_finished_jobs: _AtLeastOne = 10_000
    quota_fields: int | None = Field(default=10_000, ge=1)
    quota_stored_bytes: _AtLeastOne | None = None
    webhook_hosts: frozenset[str] = frozenset()
    webhook_secrets: Annotated[frozenset[str], NoDecode, BeforeValidator(_entries)] = Field(
        default=frozenset(), repr=False
    )
    job_timeout_s: _AtLeastOne = 900
    job_memory_bytes: int | None = Field(default=None, ge=512 * MIB)
    job_scratch_bytes: int = Field(default=4096 * MIB, ge=64 * MIB)
    import_timeout_s: _AtLeastOne = 120
    import_work_s: _Positive = 60.0
    import_memory_bytes: int = Field(default=8192 * MIB, ge=256 * MIB)
    shutdown_grace_s: _NotNegativeFloat = 5.0
    job_retention_s: _Minutes = 7 * 24 * 3600
    field_retention_s: _Minutes | None = None
    keep_originals: Literal["none", "questions", "all"] = "questions"
    max_stored_bytes: _AtLeastOne | None = None
    storage_url: str | None = Field(default=None, pattern=r"^s3://[^/\s]+(/\S*)?$")
    adopt_storage: str | None = None
    field_cache_bytes: _NotNegative = 16384 * MIB
    metrics_address: str | None = Field(default=None, pattern=r"^\S+:[0-9]{1,5}$")
    log_format: Literal["text", "json"] = "text"

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],  # noqa: ARG003 -- the base class passes all five
        init_settings: Any,
        env_settings: Any,
        dotenv_settings: Any,  # noqa: ARG003
        file_secret_settings: Any,  # noqa: ARG003
    ) -> Any:
        """What is given in Python, then the environment, which sets nothing of ``Fixed``."""

        def environment() -> dict[str, Any]:
            _refuse_old_names(os.environ)
            fixed: dict[str, Any] = json.loads(os.environ.get(_FIXED_VARIABLE, "{}"))
            return {**env_settings(), **fixed}

        return init_settings, environment

    @model_validator(mode="before")
    @classmethod
    def _bare(cls, given: dict[str, Any]) -> dict[str, Any]:
        return {
            name: value.strip("\ufeff \t\r\n") if isinstance(value, str) else value for name, value in given.items()
        }

    @property
    def needs_token(self) -> bool:
        """Whether callers must name themselves."""
        return bool(self.api_tokens)

    @property
    def published_on_loopback(self) -> bool:
        """Whether a container's port is published on the host's loopback. A port without an address is not."""
        return self.publish is not None and is_loopback(self.publish.rpartition(":")[0].strip("[]"))

    @property
    def is_private(self) -> bool:
        """Whether only this machine can reach the service."""
        return self.published_on_loopback if self.publish else is_loopback(self.host) and not self.behind_proxy

    @property
    def calls_per_s(self) -> float:
        """The rate that holds; 0: none."""
        if self.quota_calls_per_s is not None:
            return self.quota_calls_per_s
        return 0.0 if self.is_private else _RATE_BEYOND_LOOPBACK

    @property
    def scratch_dir(self) -> Path:
        """Jobs' temporary files: each worker has a folder below it and empties it after each job."""
        return self.state_dir / "scratch"

    @property
    def blob_dir(self) -> Path:
        return self.state_dir / "blobs"

    @property
    def field_cache_dir(self) -> Path:
        return self.state_dir / "field-cache"


def _refuse_old_names(environment: Mapping[str, str]) -> None:
    """Raises SettingsError for a variable of an earlier version: what it says would be passed over in silence."""
    for name in environment:
        if name in _RENAMED:
            raise SettingsError(f"{name} is not a setting: did you mean {_RENAMED[name]}?")
        if name.startswith(_PREFIX) and name.removeprefix(_PREFIX).lower() in Fixed.model_fields:
            raise SettingsError(f"{name} does not exist: the value is fixed")


_HINT = "Correct the environment variable, or unset it to use the default."
_REDIS_SCHEMES = ("redis", "rediss", "unix")


def read_settings(**given: Any) -> Settings:
    """The settings; what is None is read from REGNF_* in the environment.

    Raises InvalidInputError (INVALID_SETTINGS) naming the first faulty setting, never its value: it may be a token.
    """
    try:
        settings = Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        message = f"{_PREFIX}{where.upper()}: {first['msg'].removeprefix('Value error, ')}"
        raise InvalidInputError(message, reason="INVALID_SETTINGS", hint=_HINT) from error
    except SettingsError as error:
        raise InvalidInputError(str(error), reason="INVALID_SETTINGS", hint=_HINT) from error
    if settings.redis_url is not None:
        check_redis_url(settings.redis_url, "REGNF_REDIS_URL")
    return settings


def check_redis_url(url: str, name: str) -> None:
    """Raises InvalidInputError (INVALID_SETTINGS) naming the setting, never its value: it may hold a password."""
    if urlsplit(url).scheme not in _REDIS_SCHEMES:
        message = f"{name}: not an address of a Redis, expected redis://, rediss:// or unix://"
        raise InvalidInputError(message, reason="INVALID_SETTINGS", hint="Write for example redis://127.0.0.1:6379/0.")
