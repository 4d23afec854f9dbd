"""The front end of an image: the HTTP application alone, on the address that the settings name.

As `regnf serve` does, it refuses to listen where others can reach it without tokens, unless it is told to. Exit status
2 with the reason on stderr when it refuses or cannot listen.
"""

from __future__ import annotations

import sys

from regnf_cli import api_process
from regnf_cli.embedded_redis import StartError, open_socket
from regnf_core.errors import InvalidInputError
from regnf_state.settings import read_settings


def main() -> int:
    try:
        listener = open_socket(read_settings())
    except (InvalidInputError, StartError) as error:
        sys.stderr.write(f"{error.reason}: {error}\n")
        return 2
    api_process.main(listener.detach())
    return 0


if __name__ == "__main__":
    sys.exit(main())
