"""A real server of the S3 protocol on the loopback interface, which subprocesses reach too."""

from __future__ import annotations

import os
import secrets
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

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


@contextmanager
def server(*, refusing: bool = False) -> Iterator[str]:
    """Run a server in a process of its own and set the environment variables that select it; yields its URL.

    A server that is `refusing` accepts no credentials.
    """
    settings = {"INITIAL_NO_AUTH_ACTION_COUNT": "0"} if refusing else {}
    with (
        subprocess.Popen(
            [sys.executable, "-c", SERVER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | settings,
        ) as process,
        pytest.MonkeyPatch.context() as environment,
    ):
        assert process.stdin is not None and process.stdout is not None
        try:
            url = f"http://127.0.0.1:{int(process.stdout.readline())}"
            environment.setenv("AWS_ACCESS_KEY_ID", "testing")
            environment.setenv("AWS_SECRET_ACCESS_KEY", "testing")
            environment.setenv("AWS_REGION", "us-east-1")
            environment.setenv("AWS_ENDPOINT_URL", url)
            for name in ("AWS_SESSION_TOKEN", "AWS_PROFILE", "HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
                environment.delenv(name, raising=False)
            objects.open_bucket.cache_clear()
            yield url
        finally:
            process.stdin.close()  # ends the server
            process.wait()
            objects.open_bucket.cache_clear()


def make_bucket() -> str:
    """Create a bucket with an unused name; returns the name."""
    import boto3

    name = f"blocksar-{secrets.token_hex(6)}"
    boto3.client("s3").create_bucket(Bucket=name)
    return name
