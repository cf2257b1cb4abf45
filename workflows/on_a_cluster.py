r"""Focus on a dask cluster that is there already, and see before a long run that it will not fail for a small thing.

    python workflows/on_a_cluster.py --local-test
    python workflows/on_a_cluster.py /shared/ph.zarr --out /shared/run --scheduler tls://10.0.0.1:8786 \
        --tls-ca ca.pem --tls-cert client.pem --tls-key client.key --report run.html

The first line starts a scheduler and two workers on this machine, simulates a small scene, presses Ctrl-C when half
of its blocks are done, and goes on with the same call while a worker is killed: a minute in which to see all of the
below.

A cluster is one scheduler and any number of workers, started by `dask scheduler` and `dask worker`, by a batch system
or by Kubernetes (deploy/ has recipes). For blocksar it should be like this:

- Workers with one thread each, as many as cores, and a memory limit each: that limit is what a plan keeps to.
- The same blocksar everywhere, and the same major libraries: tasks travel by name, and are looked up over there.
- The same paths everywhere, to be read and written: samples go through the shared folder or bucket, never through
  the scheduler, which sees receipts only.
- TLS, where others reach the port: whoever may connect may run what he likes on the workers.

What the run depends on is in its folder, and nowhere else. After Ctrl-C, a kill, a power cut, with another number of
workers, or on another cluster: give the same command again. It takes up every unit whose receipt is there and whose
bytes still have their checksums, and makes the rest; the image is the same to the last byte. A worker that dies costs
the tasks that it was at. A finished run is left alone.

    exit status   meaning
    0             done
    1             processing failed: the same command goes on from there
    2             an option, the input or the cluster is not as it should be: nothing was written
    130           interrupted, likewise
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
from blocksar.cli.parsing import parse_blocks, parse_grid
from first_image import SCENE

PACKAGES = ["blocksar", "dask", "distributed", "numba", "numpy", "zarr"]
GIB = 2**30


# ---------------------------------------------------------------- the cluster


def connect(scheduler: str, ca: Path | None, cert: Path | None, key: Path | None) -> Client:
    """A client; with certificates, one that talks to nobody but holders of certificates of the same authority."""
    names = {"tls_ca_file": ca, "tls_client_cert": cert, "tls_client_key": key}
    files = {name: str(path) for name, path in names.items() if path is not None}
    if files and len(files) < len(names):
        raise blocksar.InputError("--tls-ca, --tls-cert and --tls-key go together; give all three, or none")
    try:
        return Client(scheduler, timeout=20, security=Security(require_encryption=True, **files) if files else None)
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        cause = " ".join(str(error).split())
        raise blocksar.InputError(f"no dask scheduler answers at {scheduler} ({cause}); check --scheduler") from None


def look_at_workers(client: Client) -> None:
    """Who is there: one line a worker."""
    workers = client.scheduler_info(n_workers=-1)["workers"]
    if not workers:
        raise blocksar.InputError("the scheduler has no worker; start some: dask worker ADDRESS --nthreads 1")
    for address, worker in workers.items():
        print(f"worker {address}: {worker['nthreads']} threads, memory limit {worker['memory_limit'] / GIB:.2f} GiB")
    print(f"dashboard: {client.dashboard_link}")


def check_versions(client: Client) -> None:
    """The same blocksar and the same Python on all workers; other libraries may differ, and are told."""
    found: Any = client.get_versions(packages=PACKAGES)
    here = found["client"]["packages"]
    for worker, there in found["workers"].items():
        differing = {name: there["packages"][name] for name in PACKAGES if there["packages"][name] != here[name]}
        if "blocksar" in differing:
            raise blocksar.InputError(
                f"{worker} has blocksar {differing['blocksar']}, but here is {here['blocksar']}; install the same"
            )
        for name, version in differing.items():
            print(f"note: {worker} has {name} {version}, here is {here[name]}")
    print("versions:", ", ".join(f"{name} {here[name]}" for name in PACKAGES))


def check_folder(client: Client, folder: Path) -> None:
    """Every worker must find what is written here, and what it writes must be found here."""
    if not folder.is_dir():
        raise blocksar.InputError(
            f"{folder} is no folder; make it, or give --out a place in one that all workers share"
        )
    with TemporaryDirectory(dir=folder, prefix=".probe-") as probe:
        Path(probe, "client").write_text("blocksar")

        def mark(dask_worker: Worker) -> str:  # a worker hands itself to an argument of this name
            Path(probe, dask_worker.id).write_text(Path(probe, "client").read_text())
            return dask_worker.id

        for worker, answer in client.run(mark, on_error="return").items():
            if isinstance(answer, BaseException) or not Path(probe, answer).exists():
                raise blocksar.InputError(
                    f"{worker} does not share {folder} ({answer}); give --out a folder that all workers read and write"
                )
    print(f"{folder} is one folder for all workers")


# ---------------------------------------------------------------- trouble, for --local-test


class Trouble:
    """A progress: told how far each stage is, it says so, and strikes once in the middle of the blocks."""

    def __init__(self, share: float, strike: Callable[[], object]) -> None:
        self.share = share
        self.strike: Callable[[], object] | None = strike

    def update(self, stage: str, done: int, total: int) -> None:
        print(f"  {stage}: {done} of {total}")
        if stage == "focus" and done >= self.share * total and self.strike is not None:
            strike, self.strike = self.strike, None
            strike()


def press_ctrl_c() -> None:
    print("  (Ctrl-C)")
    raise KeyboardInterrupt  # what the key comes to; a script that a shell runs in the background is deaf to the signal


def kill_a_worker(client: Client) -> None:
    worker, pid = min(client.run(os.getpid).items())
    print(f"  (kill -9 of {worker})")
    os.kill(pid, signal.SIGKILL)


# ---------------------------------------------------------------- the run


def two_workers() -> LocalCluster:
    """A cluster on this machine, as a given one would be."""
    return LocalCluster(
        n_workers=2, threads_per_worker=1, memory_limit="2GiB", host="127.0.0.1",
        dashboard_address="127.0.0.1:0", silence_logs="CRITICAL",
    )  # fmt: skip


def interrupted(client: Client, out: str, **settings: Any) -> str:
    """Simulate a small scene, begin to focus it, and be interrupted: the phase history, to go on with."""
    with TemporaryDirectory() as folder:
        scene = Path(folder, "scene.toml")
        scene.write_text(SCENE)
        source = str(blocksar.simulate(scene, f"{out}.zarr", overwrite=True))
    try:
        blocksar.focus(source, out, client=client, overwrite=True, progress=Trouble(0.5, press_ctrl_c), **settings)
    except KeyboardInterrupt:
        print("interrupted; the same call goes on from there")
    return source


def main(
    source: Annotated[str, typer.Argument(metavar="PH.zarr", help="Phase history; workers see it too.")] = "",
    out: Annotated[str, typer.Option(metavar="RUN", help="Folder of the run; workers see it too.")] = "cluster-run",
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="Of the dask scheduler.")] = None,
    tls_ca: Annotated[Path | None, typer.Option(metavar="PEM", help="Certificate of the authority.")] = None,
    tls_cert: Annotated[Path | None, typer.Option(metavar="PEM", help="Own certificate.")] = None,
    tls_key: Annotated[Path | None, typer.Option(metavar="PEM", help="Its key.")] = None,
    blocks: Annotated[str, typer.Option(metavar="auto|N", help="Angular blocks.")] = "auto",
    grid: Annotated[str | None, typer.Option(metavar="x0:x1:dx,y0:y1:dy", help="Image points, m.")] = None,
    report: Annotated[str | None, typer.Option(metavar="HTML", help="Write dask's performance report there.")] = None,
    local_test: Annotated[bool, typer.Option("--local-test", help="Two workers here, and trouble for them.")] = False,
) -> None:
    """Focus on a dask cluster: connect, look at it, focus, resume.

    Example: python workflows/on_a_cluster.py ph.zarr --out run --scheduler tcp://10.0.0.1:8786 --report run.html
    """
    settings: dict[str, Any] = {"blocks": parse_blocks(blocks), "grid": None if grid is None else parse_grid(grid)}
    progress = None
    with ExitStack() as stack:
        if local_test:
            scheduler = stack.enter_context(two_workers()).scheduler_address
        elif not source or scheduler is None:
            raise blocksar.InputError("PH.zarr or --scheduler is missing; give both, or --local-test alone")
        client = stack.enter_context(connect(scheduler, tls_ca, tls_cert, tls_key))
        look_at_workers(client)
        check_versions(client)
        if "://" not in out:  # a bucket is the same for all
            check_folder(client, Path(out).absolute().parent)
        if local_test:
            source = interrupted(client, out, **settings)
            progress = Trouble(0.75, lambda: kill_a_worker(client))
        try:
            done = blocksar.focus(source, out, client=client, progress=progress, performance_report=report, **settings)
        except KeyboardInterrupt:
            print("on_a_cluster: interrupted; the same command goes on from there", file=sys.stderr)
            raise typer.Exit(130) from None
        print(*done.summary, sep="\n")


if __name__ == "__main__":
    try:
        typer.run(main)
    except blocksar.InputError as error:
        print(f"on_a_cluster: {error}", file=sys.stderr)
        sys.exit(2)
    except blocksar.ProcessingError as error:
        print(f"on_a_cluster: {error}", file=sys.stderr)
        sys.exit(1)
