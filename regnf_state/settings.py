"""Settings of API and worker: one frozen class, read from the environment with the prefix REGNF_."""

from __future__ import annotations

import ipaddress
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

MIB = 1024 * 1024
_RATE_BEYOND_LOOPBACK = 20.0
_WRITES_OF_SEVERAL_CALLERS = 10.0


def _default_state_dir() -> Path:
    base = os.environ.get("XDG_STATE_HOME")
    return (Path(base) if base else Path.home() / ".local" / "state") / "regnf"


SECRETS = frozenset({"REGNF_API_TOKENS", "REGNF_WEBHOOK_SECRETS"})
"""Variables that only the API's process needs to see."""


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach the host. Names other than localhost are not looked up: they are not."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Settings(BaseSettings):
    """Every setting has a default that works on one machine; each is REGNF_<NAME> in the environment."""

    model_config = SettingsConfigDict(env_prefix="REGNF_", frozen=True, extra="ignore", hide_input_in_errors=True)

    host: str = "127.0.0.1"
    port: int = Field(default=8080, ge=0, le=65535)
    """0 asks the system for a free port; the address is printed once it listens."""
    state_dir: Path = Field(default_factory=_default_state_dir)
    """Blobs, the embedded Redis' files and temporary uploads live under it."""
    demo_dir: Path | None = None
    """Where the demo's files lie, which the home page offers. `regnf serve` sets it; unset: no demo."""
    redis_url: str | None = Field(default=None, repr=False)
    """Unset: `regnf serve` starts a private server of its own."""
    queue_key: Annotated[Annotated[str, Field(min_length=16)] | None, BeforeValidator(lambda given: given or None)] = (
        Field(default=None, repr=False)
    )
    """Signs what the queue in Redis holds; the same for front ends and workers. What is not signed never runs."""
    redis_password_file: Path | None = None
    """A file with Redis' password, in place of one in the address."""
    workers: int = Field(default=1, ge=0, le=64)
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where registrations run; auto: on the GPU if torch can use one."""
    threads: int | None = Field(default=None, ge=1, le=256)
    """Threads of each job's process; unset: cores / workers."""
    preload: bool = sys.platform.startswith("linux")
    """Workers load the engine once and for all jobs: each begins sooner, and an idle worker holds more memory.

    Elsewhere it is not known whether what is loaded starts threads, which a fork leaves behind.
    """
    api_tokens: frozenset[str] = Field(default=frozenset(), repr=False)
    """JSON list of `name:token`, or of tokens. Empty: no token needed, which is allowed on loopback only."""
    api_tokens_file: Path | None = None
    """More of them, one a line."""
    publish: str | None = None
    """In a container: where its port is published on the host, as compose takes it, `address:port`."""
    allowed_hosts: frozenset[str] = frozenset()
    """JSON list of the names under which the service is called: `host`, `host:port`, `*.domain`; `*`: any.

    Loopback's names and the address that a connection arrives on need not be listed.
    """
    cors_origins: frozenset[str] = frozenset()
    """JSON list of other sites whose pages may call this service: `https://name[:port]`. Empty: none."""
    allow_unauthenticated: bool = False
    """Serve beyond loopback without tokens. Say so only behind something that authenticates."""
    max_upload_bytes: int = Field(default=4096 * MIB, ge=1)
    max_request_bytes: int = Field(default=1 * MIB, ge=1024)
    """Largest JSON body."""
    upload_stall_s: float = Field(default=30.0, gt=0)
    """An upload that sends nothing for this long is refused with 408."""
    min_bytes_per_s: float = Field(default=4096.0, gt=0)
    """Slower uploads, and slower readers of answers, are cut off after the time above."""
    header_timeout_s: float = Field(default=10.0, gt=0)
    """How long a request's head may take, from the connection or the answer before it."""
    max_connections: int = Field(default=4096, ge=1)
    """Less where the system allows fewer open files. Beyond it the connections that wait for their clients go."""
    max_connections_per_address: int | None = Field(default=None, ge=1)
    """Unset: half of all. Behind a proxy every caller has the proxy's address."""
    max_queued_jobs: int = Field(default=1000, ge=1)
    rate_limit_per_s: float | None = Field(default=None, ge=0)
    """Calls a second of each caller in the long run; 0: any. Unset: any on loopback, 20 elsewhere."""
    rate_limit_burst: int = Field(default=100, ge=1)
    """Calls that a caller may make at once after a pause."""
    write_limit_per_s: float | None = Field(default=None, ge=0, allow_inf_nan=False)
    """Requests a second of each caller that are no reads, in one process; 0: any.

    Unset: any on loopback without tokens, 10 elsewhere.
    """
    write_limit_burst: int = Field(default=200, ge=1)
    """Such requests that a caller may send at once after a pause."""
    max_requests_per_caller: int = Field(default=512, ge=1)
    """Requests of each caller that are in progress in one process; without tokens, of each address."""
    max_uploads_per_caller: int = Field(default=64, ge=2)
    max_streams_per_caller: int = Field(default=100, ge=1)
    quota_active_jobs: int | None = Field(default=None, ge=1)
    """Jobs of each caller that wait or run. Unset: with tokens, as many as are left free for others."""
    max_imports_per_caller: int = Field(default=64, ge=1)
    """Imports of each caller that wait or run."""
    quota_worker_seconds_per_hour: int | None = Field(default=None, ge=1)
    """What each caller's imports and jobs may cost the workers in an hour."""
    quota_batches: int = Field(default=100, ge=1)
    """Of each caller; beyond this the one goes that was posted first of those that have ended."""
    max_batch_pairs: int = Field(default=1000, ge=1)
    max_batch_bytes: int = Field(default=8 * MIB, ge=1024)
    """Largest body of a batch."""
    caller_weights: Mapping[str, Annotated[float, Field(gt=0, le=1000)]] = Field(default_factory=dict)
    """JSON object of callers' shares of the workers, where another caller waits; of everyone else: 1."""
    worker_reserve_s: float = Field(default=300.0, ge=0, le=86400)
    """How long after a caller's last request or result other callers leave one worker free for it; 0: they do not."""
    job_niceness: int = Field(default=10, ge=0, le=19)
    """The most by which jobs and imports of callers above their share give way at the processor; 0: they do not."""
    quota_finished_jobs: int = Field(default=10_000, ge=1)
    """Of each caller; beyond this its oldest finished jobs go before their time."""
    max_finished_jobs: int = Field(default=50_000, ge=1)
    """Of all callers; beyond this the oldest ones of the caller that has most go."""
    redis_reserve: float = Field(default=0.1, ge=0, le=0.5)
    """Share of Redis' memory that new jobs and fields must leave free."""
    quota_fields: int | None = Field(default=10_000, ge=1)
    quota_stored_bytes: int | None = Field(default=None, ge=1)
    """Of each caller's uploads; what the service makes of them is not counted."""
    webhook_hosts: frozenset[str] = frozenset()
    """JSON list of the hosts that messages about jobs may go to: `host`, `host:port`, `http://host:port`."""
    webhook_secrets: frozenset[str] = Field(default=frozenset(), repr=False)
    """JSON list of `caller:whsec_<base64>`."""
    webhook_secrets_file: Path | None = None
    """More of them, one a line."""
    job_timeout_s: int = Field(default=900, ge=1)
    job_memory_bytes: int | None = Field(default=None, ge=512 * MIB)
    """Of each registration's process, beyond what its worker holds. Unset: three quarters of what the machine or its
    control group grants, divided by the workers; 1 GiB at least."""
    job_scratch_bytes: int = Field(default=4096 * MIB, ge=64 * MIB)
    """Temporary files of one job, and the largest single file that it may write."""
    import_timeout_s: int = Field(default=120, ge=1)
    import_work_s: float = Field(default=60.0, gt=0)
    import_memory_bytes: int = Field(default=8192 * MIB, ge=256 * MIB)
    heartbeat_s: float = Field(default=5.0, gt=0)
    lost_after_s: float = Field(default=90.0, gt=0)
    """A running job whose heartbeat is older than this is lost."""
    shutdown_grace_s: float = Field(default=5.0, ge=0)
    """How long a worker that is told to stop lets its job go on before it gives the job back to the queue."""
    retention_s: int = Field(default=7 * 24 * 3600, ge=60)
    """How long finished jobs and their artifacts are kept."""
    unused_field_retention_s: int | None = Field(default=None, ge=60)
    """How long a field is kept after its last use by a job. Unset: until it is deleted."""
    keep_originals: Literal["none", "questions", "all"] = "questions"
    """Which uploads stay for a while after their import, so that they can be imported anew with another description:
    those that were rejected with a question, or those of ready fields too."""
    keep_originals_s: int = Field(default=6 * 3600, ge=60)
    """How long."""
    keep_originals_bytes: int = Field(default=8192 * MIB, ge=0)
    """Of each caller; beyond this the oldest go."""
    keep_pieces_s: int = Field(default=24 * 3600, ge=60)
    """How long an upload that came in pieces waits for the next one."""
    keep_pieces_bytes: int = Field(default=8192 * MIB, ge=0)
    """Of each caller's unfinished uploads; beyond this the oldest go."""
    storage_cap_bytes: int | None = Field(default=None, ge=1)
    """Of all that is stored. Beyond this the oldest finished jobs, unused fields, batches and unfinished uploads go."""
    storage_url: str | None = Field(default=None, pattern=r"^s3://[^/\s]+(/\S*)?$")
    """An object store for several machines; unset: a folder below state_dir."""
    adopt_storage: str | None = None
    """Id of the storage that shall have this Redis from now on, in place of the one whose records it holds."""
    field_cache_bytes: int = Field(default=16384 * MIB, ge=0)
    """With an object store: how much of it a worker's machine keeps copies of, beside those in use."""

    metrics_host: str = "127.0.0.1"
    metrics_port: int | None = Field(default=None, ge=0, le=65535)
    """Where Prometheus finds `/metrics`, a port of its own without tokens; unset: nowhere."""
    log_format: Literal["text", "json"] = "text"

    @model_validator(mode="before")
    @classmethod
    def _bare(cls, given: dict[str, Any]) -> dict[str, Any]:
        """Without what a file of variables adds that Windows wrote: carriage returns and byte order marks."""
        return {
            name: value.strip("\ufeff \t\r\n") if isinstance(value, str) else value for name, value in given.items()
        }

    @property
    def needs_token(self) -> bool:
        """Whether callers must name themselves."""
        return bool(self.api_tokens) or self.api_tokens_file is not None

    @property
    def published_on_loopback(self) -> bool:
        """Whether a container's port is published on the host's loopback. A port without an address is not."""
        return self.publish is not None and is_loopback(self.publish.rpartition(":")[0].strip("[]"))

    @property
    def is_private(self) -> bool:
        """Whether only this machine can reach the service."""
        return self.published_on_loopback if self.publish else is_loopback(self.host)

    @property
    def calls_per_s(self) -> float:
        """The rate that holds; 0: none."""
        if self.rate_limit_per_s is not None:
            return self.rate_limit_per_s
        return 0.0 if self.is_private else _RATE_BEYOND_LOOPBACK

    @property
    def writes_per_s(self) -> float:
        """The rate of writes that holds; 0: none. Who is alone on a machine has nobody to keep waiting."""
        if self.write_limit_per_s is not None:
            return self.write_limit_per_s
        return 0.0 if self.is_private and not self.needs_token else _WRITES_OF_SEVERAL_CALLERS

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
