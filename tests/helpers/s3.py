"""A real server of the S3 protocol on the loopback interface, which subprocesses reach too."""

from __future__ import annotations

import atexit
import os
import secrets
import subprocess
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache

import pytest

from blocksar.places import objects

# Silence moto except for the line with the port, which the system chooses.
SERVER = """
import contextlib, logging, sys
from moto.server import ThreadedMotoServer
logging.getLogger("werkzeug").setLevel(logging.ERROR)
server = ThreadedMotoServer(ip_address="127.0.0.1", port=0)
with contextlib.redirect_stdout(sys.stderr):
    server.start()
print(server.get_host_and_port()[1], flush=True)
sys.stdin.read()
server.stop()
"""


def start(**settings: str) -> subprocess.Popen[str]:
    """Start a server, which ends with its standard input; its first line of output is its port."""
    return subprocess.Popen(
        [sys.executable, "-c", SERVER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=os.environ | settings,
    )


@cache
def usual_url() -> str:
    """The URL of the server that all tests of a process share, which goes with it."""
    process = start()
    assert process.stdout is not None
    atexit.register(process.communicate)
    return f"http://127.0.0.1:{int(process.stdout.readline())}"


@contextmanager
def selected(url: str) -> Iterator[str]:
    """Set the environment variables that select a server."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("AWS_ACCESS_KEY_ID", "testing")
        environment.setenv("AWS_SECRET_ACCESS_KEY", "testing")
        environment.setenv("AWS_REGION", "us-east-1")
        environment.setenv("AWS_ENDPOINT_URL", url)
        for name in ("AWS_SESSION_TOKEN", "AWS_PROFILE", "HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
            environment.delenv(name, raising=False)
        objects.open_bucket.cache_clear()
        yield url
    objects.open_bucket.cache_clear()


def server() -> AbstractContextManager[str]:
    """Select the server of this process; yields its URL."""
    return selected(usual_url())


@contextmanager
def refusing_server() -> Iterator[str]:
    """Run a server that accepts no credentials."""
    process = start(INITIAL_NO_AUTH_ACTION_COUNT="0")
    assert process.stdout is not None
    try:
        with selected(f"http://127.0.0.1:{int(process.stdout.readline())}") as url:
            yield url
    finally:
        process.communicate()


def make_bucket() -> str:
    """Create a bucket with an unused name; returns the name."""
    import boto3

    name = f"blocksar-{secrets.token_hex(6)}"
    boto3.client("s3").create_bucket(Bucket=name)
    return name
