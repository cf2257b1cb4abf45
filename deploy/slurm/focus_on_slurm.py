"""Focus a phase history with workers that are Slurm jobs.

    python deploy/slurm/focus_on_slurm.py PH.zarr --out RUN --jobs 8 --walltime 02:00:00 --queue compute

This process is scheduler and client: it submits one job for every worker through dask-jobqueue, waits until they run,
focuses, and cancels them. It needs one core and 2 GiB for the duration of the run; `focus.sbatch` runs it as a job.
However it ends, the same command resumes the run from the receipts in RUN.

Connections are encrypted with certificates that are created for this run and readable only by you: other users of the
cluster cannot connect to the scheduler. Exit statuses are those of `blocksar focus`.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

import blocksar
from blocksar import stores
from blocksar.application import parsing
from blocksar.application.settings import Settings
from blocksar.cli import endings, option_groups, printing
from blocksar.errors import InputError, ProcessingError
from blocksar.imaging.method import ChainOptions
from blocksar.options import options_of, read_values
from blocksar.progress import Progress

if TYPE_CHECKING:
    from dask_jobqueue.slurm import SLURMCluster
    from distributed import Client


MIB = 2**20
NANNY = 512 * MIB  # bytes of a job above its worker's memory limit: dask stops a worker before Slurm kills the job

# The settings of a cluster that blocksar starts itself: plans respect the memory limit, and spilling would hide a
# violation; a worker that has not responded for a minute counts as lost.
SETTINGS: dict[str, object] = {
    "distributed.admin.low-level-log-length": 10,
    "distributed.scheduler.work-stealing": False,
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.scheduler.worker-ttl": 60.0,
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": 0.9,
    "distributed.worker.memory.terminate": 0.98,
}
# Freed blocks return to the system at once; memory of groups of rows and of chunks is kept by malloc.
ENVIRONMENT = {
    "NUMBA_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": str(24 * MIB),
    "MALLOC_TRIM_THRESHOLD_": str(64 * MIB),
}
COMPILE = ["-m", "blocksar", "compile", "--quiet"]


def prologue() -> list[str]:
    """Lines of a worker's job before the worker starts: settings, and compilation of the loops.

    Compiling takes more memory than a block may use. It is done in a separate process, from which the worker gets the
    loops through numba's cache.
    """
    dask_settings = {
        f"DASK_{key}".upper().replace(".", "__").replace("-", "_"): str(value) for key, value in SETTINGS.items()
    }
    exports = [f"export {name}={shlex.quote(value)}" for name, value in (dask_settings | ENVIRONMENT).items()]
    return [*exports, shlex.join([sys.executable, *COMPILE])]


def make_cluster(
    folder: Path,
    *,
    memory: int,
    walltime: str,
    queue: str | None = None,
    account: str | None = None,
    interface: str | None = None,
    scratch: str = "${TMPDIR:-/tmp}",
    directives: list[str] | None = None,
) -> SLURMCluster:
    """Start a scheduler in this process; jobs of one worker with one thread each are added by `scale`.

    Parameters
    ----------
    folder : Path
        For certificates and the workers' logs; shared by all nodes.
    memory : int
        Memory of a worker, bytes.
    interface : str, optional
        Network between the nodes, such as ib0.
    scratch : str
        Folder for temporary files, expanded by the shell of the job.
    directives : list of str, optional
        Further options of sbatch, such as `--constraint=avx512`.

    Raises
    ------
    InputError
        If dask-jobqueue is not installed.
    """
    try:
        from dask_jobqueue.slurm import SLURMCluster
        from distributed.security import Security

        security = Security.temporary()
    except ImportError as error:
        raise InputError(f"{error.name} is not installed; install blocksar[slurm]") from None
    folder.mkdir(parents=True, exist_ok=True)
    return SLURMCluster(
        cores=1,
        processes=1,
        memory=f"{memory}B",
        job_mem=f"{(memory + NANNY) // MIB}M",
        walltime=walltime,
        queue=queue,
        account=account,
        interface=interface,
        job_name="blocksar-worker",
        job_extra_directives=directives or [],
        job_script_prologue=prologue(),
        local_directory=scratch,
        log_directory=str(folder),
        shared_temp_directory=str(folder),
        death_timeout=120,
        security=security,
        protocol="tls://",
        # Their HTTP servers have no access control: each answers on its own node only.
        scheduler_options={"dashboard_address": "127.0.0.1:0"},
        worker_extra_args=["--no-dashboard", "--dashboard-address", "127.0.0.1:0"],
        silence_logs="critical",
    )


def check_job(script: str) -> None:
    """Check that Slurm accepts such a job, without submitting it.

    Raises
    ------
    InputError
        If it does not, or there is no sbatch.
    """
    if shutil.which("sbatch") is None:
        raise InputError("there is no sbatch on this machine; run this where Slurm accepts jobs, or give --job-script")
    answer = subprocess.run(["sbatch", "--test-only"], input=script, capture_output=True, text=True, check=False)
    if answer.returncode:
        reason = " ".join(answer.stderr.split())
        raise InputError(f"sbatch refuses the workers' jobs ({reason}); check --queue, --account and --walltime")


@contextmanager
def closing(cluster: SLURMCluster) -> Iterator[None]:
    """Cancel the jobs at the end, whatever their state."""
    try:
        yield
    finally:
        with suppress(AssertionError):  # raised by dask for jobs that could not be submitted; it would hide the cause
            cluster.close()


def wait_for_workers(client: Client, jobs: int, seconds: float) -> None:
    """Wait for the workers, at most so many `seconds`; the run then starts with those available.

    The plan divides the scene among these workers; later ones are used as well.

    Raises
    ------
    ProcessingError
        If none is running.
    """
    with suppress(TimeoutError):
        client.wait_for_workers(jobs, timeout=seconds)
    running = len(client.nthreads())
    if not running:
        raise ProcessingError(
            f"none of {jobs} jobs started within {seconds:.0f} s: see squeue for the reason; try again later"
        )
    typer.echo(f"{running} of {jobs} workers are running", err=True)


OPTIONS = options_of(Settings, "processor", "blocks", "grid", "overwrite")


@option_groups.taking(OPTIONS)
@option_groups.taking(options_of(ChainOptions, "coefficients"), option_groups.ALTERNATIVES)
def main(
    source: Annotated[str, typer.Argument(metavar="PH.zarr", help="Phase-history store; shared by all nodes.")],
    out: Annotated[str, typer.Option(metavar="RUN", help="Folder of the run; shared by all nodes.")],
    jobs: Annotated[int, typer.Option(min=1, help="Number of workers, each a job with one core.")] = 4,
    memory: Annotated[str, typer.Option(metavar="SIZE", help="Memory of each worker.")] = "3GiB",
    walltime: Annotated[str, typer.Option(metavar="HH:MM:SS", help="Time limit of the workers' jobs.")] = "02:00:00",
    queue: Annotated[str | None, typer.Option(metavar="NAME", help="Partition of the workers' jobs.")] = None,
    account: Annotated[str | None, typer.Option(metavar="NAME", help="Account of the workers' jobs.")] = None,
    interface: Annotated[
        str | None, typer.Option(metavar="NAME", help="Network between the nodes, such as ib0.")
    ] = None,
    scratch: Annotated[
        str, typer.Option(metavar="DIR", help="Folder for temporary files, expanded by the shell of the job.")
    ] = "${TMPDIR:-/tmp}",
    directive: Annotated[
        list[str] | None, typer.Option(metavar="OPTION", help="Further options of sbatch, such as --constraint=avx512.")
    ] = None,
    wait_workers: Annotated[
        float,
        typer.Option(min=1, metavar="SECONDS", help="Time to wait for the jobs to start, and for others if all end."),
    ] = 3600,
    quiet: option_groups.Quiet = False,
    job_script: Annotated[
        bool, typer.Option("--job-script", help="Print the job of a worker without submitting it.")
    ] = False,
    **given: Any,
) -> None:
    """Focus a phase history with workers that are Slurm jobs.

    Example: [bold]python deploy/slurm/focus_on_slurm.py table1.zarr --out run --jobs 8 --queue compute[/bold]
    """
    endings.catch_signals()
    try:
        settings = read_values(OPTIONS, given)
        if not job_script:
            stores.open_phase_history(source)  # refuse it before jobs are queued

        import dask
        from distributed import Client

        with dask.config.set(SETTINGS):
            cluster = make_cluster(
                Path(f"{os.path.abspath(out)}.slurm"),
                memory=parsing.parse_memory(memory),
                walltime=walltime,
                queue=queue,
                account=account,
                interface=interface,
                scratch=scratch,
                directives=directive,
            )
            with closing(cluster):
                if job_script:
                    typer.echo(cluster.job_script(), nl=False)
                    return
                check_job(cluster.job_script())
                with Client(cluster) as client:
                    cluster.scale(jobs=jobs)
                    wait_for_workers(client, jobs, wait_workers)
                    with Progress(quiet=quiet) as progress:
                        report = blocksar.focus(
                            source,
                            out,
                            threads=1,
                            client=client,
                            wait_workers=wait_workers,
                            progress=progress,
                            **settings,
                        )
        printing.show(report)
    except InputError as error:
        _end(str(error), endings.WRONG_INPUT)
    except (ProcessingError, OSError) as error:
        _end(str(error), endings.FAILED)
    except KeyboardInterrupt:
        _end("interrupted; the same command resumes the run", endings.INTERRUPTED)
    except endings.Terminated:
        _end("terminated; the same command resumes the run", endings.TERMINATED)


def _end(message: str, status: int) -> NoReturn:
    typer.echo(f"focus_on_slurm: {message}", err=True)
    raise typer.Exit(status)


if __name__ == "__main__":
    typer.run(main)
