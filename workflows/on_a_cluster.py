r"""Focus on an existing dask cluster, after checks of everything that would make a long run fail.

    python workflows/on_a_cluster.py --local-test
    python workflows/on_a_cluster.py /shared/ph.zarr --out /shared/run --scheduler tls://10.0.0.1:8786 \
        --tls-ca ca.pem --tls-cert client.pem --tls-key client.key --report run.html

The first command is a test of one minute that shows all of this: it starts a scheduler and two workers on this
machine, simulates a small scene, presses Ctrl-C when half of its blocks are done, repeats the call, and kills a worker
in the meantime.

A cluster is one scheduler and any number of workers, started by `dask scheduler` and `dask worker`, by a batch system
or by Kubernetes (see the recipes in deploy/). blocksar needs:

- Workers with one thread each, as many as cores, each with a memory limit; plans respect that limit.
- The same blocksar and the same major libraries everywhere: tasks are sent by name and looked up by the workers.
- The same paths everywhere, readable and writable: samples go through the shared folder or bucket, never through the
  scheduler, which receives receipts only.
- TLS if others can reach the port: whoever connects can run any code on the workers.

The state of a run is in its folder only. After Ctrl-C, a kill or a power cut, with another number of workers or on
another cluster, give the same command again. It reuses every unit of work whose receipt exists and whose bytes still
match their checksums, and computes the rest; the image is the same to the last byte. If a worker dies, only its
current tasks are repeated. A finished run is not changed.

    exit status   meaning
    0             done
    1             processing failed: the same command resumes the run
    2             an option, the input or the cluster is wrong: nothing was written
    130           interrupted: the same command resumes the run
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer
from distributed import Client, LocalCluster, Worker
from distributed.security import Security

import blocksar
from blocksar.application.settings import Settings
from blocksar.cli.option_groups import taking
from blocksar.graph.units import await_workers, waiting_for_workers
from blocksar.options import options_of, read_values
from blocksar.progress import Listener
from first_image import SCENE

PACKAGES = ["blocksar", "dask", "distributed", "numba", "numpy", "zarr"]
GIB = 2**30


def connect(scheduler: str, ca: Path | None, cert: Path | None, key: Path | None) -> Client:
    """Connect to a scheduler; with certificates, only to one with a certificate of the same authority.

    Raises
    ------
    blocksar.InputError
        If certificates are missing, or no scheduler answers.
    """
    names = {"tls_ca_file": ca, "tls_client_cert": cert, "tls_client_key": key}
    files = {name: str(path) for name, path in names.items() if path is not None}
    if files and len(files) < len(names):
        raise blocksar.InputError("--tls-ca, --tls-cert and --tls-key go together; give all three, or none")
    try:
        return Client(scheduler, timeout=20, security=Security(require_encryption=True, **files) if files else None)
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        cause = " ".join(str(error).split())
        raise blocksar.InputError(f"no dask scheduler answers at {scheduler} ({cause}); check --scheduler") from None


class Notes(Listener):
    """A progress listener that prints the notes."""

    def note(self, text: str, *, again: bool = False) -> None:
        print(f"note: {text}", flush=True)


def print_workers(client: Client, wait_workers: float) -> None:
    """Print one line per worker, once there is one."""
    with waiting_for_workers(wait_workers):
        workers = await_workers(client, Notes())
    for address, worker in workers.items():
        print(f"worker {address}: {worker['nthreads']} threads, memory limit {worker['memory_limit'] / GIB:.2f} GiB")
    print(f"dashboard: {client.dashboard_link}")


def check_versions(client: Client) -> None:
    """Refuse workers with another blocksar; print other libraries that differ."""
    versions: Any = client.get_versions(packages=PACKAGES)
    here = versions["client"]["packages"]
    for worker, there in versions["workers"].items():
        differing = {name: there["packages"][name] for name in PACKAGES if there["packages"][name] != here[name]}
        if "blocksar" in differing:
            raise blocksar.InputError(
                f"{worker} has blocksar {differing['blocksar']}, but here is {here['blocksar']}; install the same"
            )
        for name, version in differing.items():
            print(f"note: {worker} has {name} {version}, here is {here[name]}")
    print("versions:", ", ".join(f"{name} {here[name]}" for name in PACKAGES))


def check_folder(client: Client, folder: Path) -> None:
    """Check that every worker reads what is written here, and the other way round."""
    if not folder.is_dir():
        raise blocksar.InputError(
            f"{folder} is not a folder; create it, or give --out a path in a folder that all workers share"
        )
    with TemporaryDirectory(dir=folder, prefix=".probe-") as probe:
        Path(probe, "client").write_text("blocksar")

        def mark(dask_worker: Worker) -> str:  # dask passes the worker to an argument of this name
            Path(probe, dask_worker.id).write_text(Path(probe, "client").read_text())
            return dask_worker.id

        for worker, answer in client.run(mark, on_error="return").items():
            if isinstance(answer, BaseException) or not Path(probe, answer).exists():
                raise blocksar.InputError(
                    f"{worker} does not share {folder} ({answer}); give --out a folder that all workers read and write"
                )
    print(f"{folder} is shared by all workers")


class Fault:
    """A progress listener that prints the progress of each stage, and causes one fault during the blocks."""

    def __init__(self, share: float, cause: Callable[[], object]) -> None:
        self.share = share  # of the blocks that are done before the fault
        self.cause: Callable[[], object] | None = cause

    def update(self, stage: str, done: int, total: int) -> None:
        print(f"  {stage}: {done} of {total}")
        if stage == "focus" and done >= self.share * total and self.cause is not None:
            cause, self.cause = self.cause, None
            cause()


def press_ctrl_c() -> None:
    print("  (Ctrl-C)")
    raise KeyboardInterrupt  # not the signal: a shell lets scripts in the background ignore it


def kill_a_worker(client: Client) -> None:
    worker, pid = min(client.run(os.getpid).items())
    print(f"  (kill -9 of {worker})")
    os.kill(pid, signal.SIGKILL)


def two_workers() -> LocalCluster:
    """Start a cluster on this machine that is configured like an external one."""
    return LocalCluster(
        n_workers=2, threads_per_worker=1, memory_limit="2GiB", host="127.0.0.1",
        dashboard_address="127.0.0.1:0", silence_logs="CRITICAL",
    )  # fmt: skip


def start_and_interrupt(client: Client, out: str, **settings: Any) -> str:
    """Simulate a small scene, start to focus it, and interrupt; the path of its phase history."""
    with TemporaryDirectory() as folder:
        scene = Path(folder, "scene.toml")
        scene.write_text(SCENE)
        source = str(blocksar.simulate(scene, f"{out}.zarr", overwrite=True))
    try:
        blocksar.focus(source, out, client=client, overwrite=True, progress=Fault(0.5, press_ctrl_c), **settings)
    except KeyboardInterrupt:
        print("interrupted; the same call resumes the run")
    return source


OPTIONS = options_of(Settings, "wait_workers", "blocks", "grid")


@taking(OPTIONS)
def main(
    source: Annotated[
        str, typer.Argument(metavar="PH.zarr", help="Phase history, at a path shared with the workers.")
    ] = "",
    out: Annotated[
        str, typer.Option(metavar="RUN", help="Folder of the run, at a path shared with the workers.")
    ] = "cluster-run",
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="Address of the dask scheduler.")] = None,
    tls_ca: Annotated[Path | None, typer.Option(metavar="PEM", help="Certificate of the authority.")] = None,
    tls_cert: Annotated[Path | None, typer.Option(metavar="PEM", help="Own certificate.")] = None,
    tls_key: Annotated[Path | None, typer.Option(metavar="PEM", help="Its key.")] = None,
    report: Annotated[str | None, typer.Option(metavar="HTML", help="Write dask's performance report there.")] = None,
    local_test: Annotated[bool, typer.Option("--local-test", help="Test with two workers on this machine.")] = False,
    **given: Any,
) -> None:
    """Focus on a dask cluster: connect, check, focus, resume.

    Example: python workflows/on_a_cluster.py ph.zarr --out run --scheduler tcp://10.0.0.1:8786 --report run.html
    """
    settings = read_values(OPTIONS, given)
    progress: Listener | Fault = Notes()
    with ExitStack() as stack:
        if local_test:
            scheduler = stack.enter_context(two_workers()).scheduler_address
        elif not source or scheduler is None:
            raise blocksar.InputError("PH.zarr or --scheduler is missing; give both, or --local-test alone")
        client = stack.enter_context(connect(scheduler, tls_ca, tls_cert, tls_key))
        print_workers(client, settings["wait_workers"])
        check_versions(client)
        if "://" not in out:  # a bucket has one address for all
            check_folder(client, Path(out).absolute().parent)
        if local_test:
            source = start_and_interrupt(client, out, **settings)
            progress = Fault(0.75, lambda: kill_a_worker(client))
        try:
            result = blocksar.focus(
                source, out, client=client, progress=progress, performance_report=report, **settings
            )
        except KeyboardInterrupt:
            print("on_a_cluster: interrupted; the same command resumes the run", file=sys.stderr)
            raise typer.Exit(130) from None
        print(*result.summary, sep="\n")


if __name__ == "__main__":
    try:
        typer.run(main)
    except blocksar.InputError as error:
        print(f"on_a_cluster: {error}", file=sys.stderr)
        sys.exit(2)
    except blocksar.ProcessingError as error:
        print(f"on_a_cluster: {error}", file=sys.stderr)
        sys.exit(1)
