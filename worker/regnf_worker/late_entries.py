"""Fields that became a library's entries while their import ran.

Such an import may have looked for the entry too early, and work that runs is not queued a second time. So the worker
looks once more when the import's process has ended.
"""

from __future__ import annotations

import logging

from redis import Redis
from redis.exceptions import RedisError

from regnf_state.queue import JobQueue, Work
from regnf_state.records import UnreadableRecordError
from regnf_state.redis.jobs import RedisRecordStore
from regnf_worker.library_models import is_unmodeled_entry

logger = logging.getLogger(__name__)


class LateEntries:
    """For one import after the other. An import that begins with the entry has had its turn: what is no object has no
    model, and is not tried again."""

    def __init__(self, redis: Redis, queue: JobQueue) -> None:
        self._records = RedisRecordStore(redis)  # without the journal: its storage does not survive the worker's forks
        self._queue = queue
        self._known = False

    def before(self, work: Work) -> None:
        """To be called before the import's process."""
        self._known = self._is_unmodeled(work)

    def after(self, work: Work) -> None:
        """To be called once the import is in no list any more: queues it again, for the model alone."""
        if not self._known and self._is_unmodeled(work):
            try:
                self._queue.enqueue_import(work.argument, work.attempt)
            except RedisError as error:
                logger.warning("the model of entry %s is left to its first job: %s", work.argument, error)

    def _is_unmodeled(self, work: Work) -> bool:
        try:
            return is_unmodeled_entry(self._records, work.argument, work.attempt)
        except (RedisError, UnreadableRecordError) as error:
            logger.warning("whether %s is an entry without a model is not known: %s", work.argument, error)
            return False
