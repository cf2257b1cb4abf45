"""The cluster of a sweep."""

from __future__ import annotations

import shutil
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from blocksar.errors import InputError
from inbox.records import Settings

if TYPE_CHECKING:
    from distributed import Client


class NoClusterError(RuntimeError):
    """No cluster can be started or reached."""


@dataclass
class Cluster:
    """One cluster for the whole sweep: opened when a collection first needs it, and again after a failure."""

    settings: Settings
    scheduler: str | None
    scratch: Path
    _stack: ExitStack = field(default_factory=ExitStack)
    _client: Client | None = None

    def __enter__(self) -> Self:
        self._clear()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client = None
        try:
            self._stack.__exit__(kind, error, trace)
        finally:
            self._clear()

    def _clear(self) -> None:
        """Remove temporary files of the workers, including those of an earlier, killed sweep."""
        shutil.rmtree(self.scratch, ignore_errors=True)

    def client(self) -> Client | None:
        """A client whose cluster has workers; None if this process is to do the work.

        Raises
        ------
        NoClusterError
            If no cluster can be started or reached.
        """
        names = ("workers", "threads", "memory_limit", "wait_workers")
        workers, threads, memory_limit, wait_workers = (self.settings[name] for name in names)
        if workers == 0 and self.scheduler is None:
            return None
        # Heavy, and not needed by a sweep without new collections.
        from blocksar.graph.cluster import cluster_size, open_client
        from blocksar.graph.machine import resources

        try:
            if self._client is None:
                own = resources(workers, threads, memory_limit)
                opened = open_client(
                    scheduler=self.scheduler, **own._asdict(), scratch=str(self.scratch), wait_workers=wait_workers
                )
                self._client = self._stack.enter_context(opened)
            cluster_size(self._client)
        except (InputError, OSError) as error:
            raise NoClusterError(str(error)) from error
        return self._client

    def discard(self, error: Exception) -> None:
        """Close a cluster that failed; the next collection gets a new one."""
        self._client = None
        with suppress(Exception):  # a lost cluster may fail to close
            self._stack.__exit__(type(error), error, error.__traceback__)
