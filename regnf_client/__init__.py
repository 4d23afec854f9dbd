"""A client of a regnf service. It needs httpx, pydantic and NumPy, but not torch.

    from regnf_client import Client

    with Client("http://127.0.0.1:8080") as client:
        result = client.register("room.ckpt", "chair.glb", {"min": [-0.4, -0.3, 0.0], "max": [0.1, 0.2, 0.4]})
        print(result.verdict, result.probability, result.level, result.T_scene_object)

``AsyncClient`` has the same methods, to be awaited.
"""

from regnf_client.answers import NoWorkerError, ServiceError, UnreachableError, WaitTimeoutError
from regnf_client.batches import Pair, PairResult
from regnf_client.client import AsyncClient, Client
from regnf_client.models import BatchOutcome, Entry, Event, Field, Job, Rendering, Result

__all__ = [
    "AsyncClient",
    "BatchOutcome",
    "Client",
    "Entry",
    "Event",
    "Field",
    "Job",
    "NoWorkerError",
    "Pair",
    "PairResult",
    "Rendering",
    "Result",
    "ServiceError",
    "UnreachableError",
    "WaitTimeoutError",
]
