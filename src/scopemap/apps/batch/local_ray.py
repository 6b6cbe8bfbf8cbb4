"""A Ray of this machine alone, which asks no other machine anything.

Ray (2.60) has no option and no variable for that. With `include_dashboard=False` its head node starts an API server all
the same, for usage statistics. That one asks the metadata addresses of three clouds which of them this is
(`get_cluster_config_to_report`), before it looks at RAY_USAGE_STATS_ENABLED. So the head node starts without the API
server, by the one private name of Ray that scopemap knows.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from scopemap.engine.errors import InputError

_OBJECTS_BYTES = 100 << 20  # videos and results go by files


def keep_to_loopback() -> None:
    """Have Ray, which is not imported yet, take 127.0.0.1 as the address of this machine."""
    os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"  # its word for a Ray of one machine


def start_local_ray(ray: Any, folder: str, cores: int, memory_bytes: int) -> None:
    """Start Ray, the module `ray`, with its files in a folder. Raises `InputError` where it would ask others."""
    with _without_api_server(ray.__version__):
        ray.init(
            "local",
            num_cpus=cores,
            _memory=memory_bytes,
            object_store_memory=_OBJECTS_BYTES,
            include_dashboard=False,
            _temp_dir=folder,
            log_to_driver=False,
            logging_level=logging.ERROR,
        )


@contextmanager
def _without_api_server(version: str) -> Iterator[None]:
    """Let Ray's head node start without its API server meanwhile."""
    try:
        from ray._private.node import Node

        start = Node.start_api_server
    except (ImportError, AttributeError):
        fault = "it is not known how to keep it from asking which cloud this is"
        raise InputError(f"starting Ray {version}: {fault}; install the version in constraints.txt") from None
    Node.start_api_server = lambda *_, **__: None  # type: ignore[method-assign]
    try:
        yield
    finally:
        Node.start_api_server = start  # type: ignore[method-assign]
