"""Which process answers at an address."""

from __future__ import annotations

import psutil


def api_process(address: str) -> int:
    """The process of the API that listens there.

    The supervisor holds the listening socket too, so that a restart of the API drops no connection: it is passed over.
    Raises RuntimeError when there is none.
    """
    port = int(address.rsplit(":", 1)[1])
    for process in psutil.process_iter():
        try:
            if "regnf_cli.api_process" in process.cmdline() and _listens(process, port):
                return process.pid
        except psutil.Error:  # another user's process, or one that has just ended
            continue
    raise RuntimeError(f"no API process listens at {address}")


def _listens(process: psutil.Process, port: int) -> bool:
    return any(
        bool(found.laddr) and found.laddr.port == port and found.status == psutil.CONN_LISTEN
        for found in process.net_connections("tcp")
    )
