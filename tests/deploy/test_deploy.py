"""The files of deploy/ match their schemas, each other and the workflow, as far as can be checked without an engine."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import click
import dask
import distributed.cli.dask_scheduler
import distributed.cli.dask_worker
import pytest
import typer
import yaml
from dask.utils import parse_bytes
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from repository import ROOT

import blocksar
from blocksar.cli import endings
from blocksar.graph import cluster

DEPLOY = ROOT / "deploy"
PARTS = ("systemd", "cron", "container", "kubernetes", "slurm")
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

SERVICE = DEPLOY / "systemd" / "blocksar-inbox.service"
CONTAINERFILE = DEPLOY / "container" / "Containerfile"
FOCUS_ON_SLURM = DEPLOY / "slurm" / "focus_on_slurm.py"

IMAGE = f"localhost/blocksar:{blocksar.__version__}"
PYTHON, WORKFLOW = "/opt/blocksar/.venv/bin/python", "/opt/blocksar/workflows/process_inbox.py"
INBOX, OUTBOX, KERNELS = "/srv/blocksar/inbox", "/srv/blocksar/outbox", "/var/cache/blocksar"
GIB = 2**30


# ---------------------------------------------------------------- reading the files


def text(*names: str) -> str:
    return DEPLOY.joinpath(*names).read_text(encoding="utf-8")


def unit(path: Path) -> dict[str, list[str]]:
    """All values of every directive of a systemd unit; the sections are ignored."""
    found: dict[str, list[str]] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        if line and line[0] not in "#[":
            key, value = line.split("=", 1)
            found.setdefault(key, []).append(value)
    return found


def service_command() -> list[str]:
    """ExecStart, with the default options substituted as systemd does."""
    directives = unit(SERVICE)
    (line,), defaults = directives["ExecStart"], shlex.split(" ".join(directives["Environment"]))
    options = next(value.partition("=")[2] for value in defaults if value.startswith("BLOCKSAR_OPTIONS="))
    return [word for part in line.split() for word in (options.split() if part == "$BLOCKSAR_OPTIONS" else [part])]


def crontab() -> Any:
    library = pytest.importorskip("crontab")
    return library.CronTab(tab=text("cron", "blocksar.crontab"))


def cron_command() -> list[str]:
    return shlex.split(next(iter(crontab())).command)


@cache
def compose() -> dict[str, Any]:
    return dict(yaml.safe_load(text("container", "compose.yaml")))


@cache
def manifests() -> list[dict[str, Any]]:
    """Every Kubernetes object except the kustomization."""
    listed = yaml.safe_load(text("kubernetes", "kustomization.yaml"))["resources"]
    return [made for name in listed for made in yaml.safe_load_all(text("kubernetes", name))]


def manifest(kind: str, name: str) -> dict[str, Any]:
    (found,) = (made for made in manifests() if (made["kind"], made["metadata"]["name"]) == (kind, name))
    return found


def pods() -> dict[str, dict[str, Any]]:
    """Pod specifications by role."""
    dask_cluster = manifest("DaskCluster", "blocksar")["spec"]
    sweep = manifest("CronJob", "inbox")["spec"]["jobTemplate"]["spec"]["template"]
    return {
        "scheduler": dask_cluster["scheduler"]["spec"],
        "worker": dask_cluster["worker"]["spec"],
        "inbox": sweep["spec"],
    }


class Box(NamedTuple):
    """A container of compose or Kubernetes: its role, image, command and writable paths."""

    name: str
    image: str
    command: list[str]
    writable: set[str]


def boxes() -> Iterator[Box]:
    for name, service in compose()["services"].items():
        mounts = [re.sub(r"\$\{.*?\}", "X", mount).split(":") for mount in service["volumes"]]
        writable = {mount[1] for mount in mounts if mount[2:] != ["ro"]} | set(service["tmpfs"])
        yield Box(name, service["image"], service["command"], writable)
    for name, pod in pods().items():
        for made in [*pod.get("initContainers", []), *pod["containers"]]:
            writable = {mount["mountPath"] for mount in made["volumeMounts"] if not mount.get("readOnly")}
            kind = name if made in pod["containers"] else made["name"]
            yield Box(kind, made["image"], [*made.get("command", []), *made["args"]], writable)


def commands(kind: str) -> list[list[str]]:
    return [box.command for box in boxes() if box.name == kind]


def sweeps() -> dict[str, list[str]]:
    """Arguments of every command line that runs the workflow."""
    found = {
        "systemd": service_command()[2:],
        "cron": cron_command()[1:],
        "container/README.md": single_container(),
    }
    found |= {f"inbox {number}": command[2:] for number, command in enumerate(commands("inbox"))}
    assert len(found) == 5
    return found


def single_container() -> list[str]:
    """Arguments of the workflow in the README's single container without compose."""
    line = next(block for block in fenced("container", "bash") if "podman run" in block)
    words = shlex.split(line.replace("\\\n", " "))
    return words[words.index(WORKFLOW) + 1 :]


def fenced(part: str, language: str = "bash") -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text(part, "README.md"), re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def workflow() -> Iterator[Any]:
    """The script as a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "workflows"))
        import process_inbox
        from inbox import statuses

        yield SimpleNamespace(
            main=process_inbox.main, __doc__=process_inbox.__doc__, DONE=statuses.DONE, FAILED=statuses.FAILED,
            USAGE=statuses.USAGE, QUARANTINED=statuses.QUARANTINED, BUSY=statuses.BUSY,
        )  # fmt: skip


@pytest.fixture(scope="module")
def recipe() -> Iterator[Any]:
    """The Slurm script as a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOCUS_ON_SLURM.parent))
        import focus_on_slurm

        yield focus_on_slurm


def arguments(function: Any, words: list[str]) -> dict[str, Any]:
    """Parameters that typer parses from a command line; it refuses invalid options and arguments."""
    app = typer.Typer()
    app.command()(function)
    return typer.main.get_command(app).make_context("command", list(words)).params


def tool(name: str) -> str:
    """Path of a program beside this Python (where pip installs it) or on the path; skip the test without it."""
    found = shutil.which(name, path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))
    if found is None:
        pytest.skip(f"{name} is not installed")
    return found


def accepts(*command: str | Path) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert not done.stdout + done.stderr


# ---------------------------------------------------------------- schemas and linters


@pytest.mark.slow
def test_the_compose_file_matches_its_specification() -> None:
    schemas = pytest.importorskip("check_jsonschema.builtin_schemas")
    import jsonschema

    jsonschema.validate(compose(), schemas.get_builtin_schema("vendor.compose-spec"))


def as_kubernetes(made: dict[str, Any]) -> list[dict[str, Any]]:
    """The native Kubernetes objects of a manifest; for a DaskCluster the pods and the service the operator creates."""
    if made["kind"] != "DaskCluster":
        return [made]
    head = {"apiVersion": "v1", "metadata": {"name": "x"}}
    scheduler, worker = made["spec"]["scheduler"], made["spec"]["worker"]
    return [
        {**head, "kind": "Pod", "spec": scheduler["spec"]},
        {**head, "kind": "Service", "spec": scheduler["service"]},
        {**head, "kind": "Pod", "spec": worker["spec"]},
    ]


@pytest.mark.parametrize("oldest", [True, False])
def test_kubernetes_objects_match_their_schemas(oldest: bool) -> None:
    library = pytest.importorskip("kubernetes_validate")
    named = re.search(r"Kubernetes (1\.\d+) or newer", text("kubernetes", "README.md"))
    assert named is not None
    version = named[1] if oldest else library.latest_version()
    for made in manifests():
        for known in as_kubernetes(made):
            assert version.startswith(library.validate(known, version, strict=True))


def test_the_dask_cluster_has_the_fields_the_operator_expects() -> None:
    made = manifest("DaskCluster", "blocksar")
    assert made["apiVersion"] == "kubernetes.dask.org/v1"
    assert set(made["spec"]) == {"scheduler", "worker"}
    assert set(made["spec"]["scheduler"]) == {"spec", "service"}
    assert set(made["spec"]["worker"]) == {"spec", "replicas"}
    service = made["spec"]["scheduler"]["service"]
    # Labels that the operator sets, and port names that it requires.
    assert service["selector"] == {"dask.org/cluster-name": "blocksar", "dask.org/component": "scheduler"}
    assert {port["name"] for port in service["ports"]} == {"tcp-comm", "http-dashboard"}


def test_systemd_accepts_the_units(tmp_path: Path) -> None:
    program = tool("systemd-analyze")
    for path in (SERVICE, SERVICE.with_suffix(".timer")):
        # The verification requires that the program and the documentation exist.
        made = path.read_text(encoding="utf-8").replace(PYTHON, sys.executable)
        (tmp_path / path.name).write_text(re.sub(r"(?m)^Documentation=.*\n", "", made))
    accepts(program, "verify", tmp_path / SERVICE.name, tmp_path / SERVICE.with_suffix(".timer").name)


def test_systemd_creates_the_user_and_the_folders(tmp_path: Path) -> None:
    program = tool("systemd-sysusers")
    (tmp_path / "etc").mkdir()
    conf = DEPLOY / "systemd" / "blocksar.sysusers.conf"
    done = subprocess.run(
        [program, "--dry-run", f"--root={tmp_path}", conf], capture_output=True, text=True, check=True
    )
    assert "blocksar" in done.stdout + done.stderr
    lines = [line.split() for line in text("systemd", "blocksar.tmpfiles.conf").splitlines() if line[0] != "#"]
    folders = {fields[1]: fields[2:5] for fields in lines if fields[0] == "d"}
    assert len(folders) == len(lines) == 3
    assert folders[OUTBOX][1:] == unit(SERVICE)["User"] + unit(SERVICE)["Group"]


def test_shell_scripts_pass_shellcheck() -> None:
    scripts = [DEPLOY / "cron" / "sweep", DEPLOY / "slurm" / "focus.sbatch"]
    found = [p for p in DEPLOY.rglob("*") if p.is_file() and p.read_bytes().startswith((b"#!/bin/sh", b"#!/bin/bash"))]
    assert sorted(found) == sorted(scripts)
    assert scripts[0].stat().st_mode & stat.S_IXUSR, "cron starts it as a program"
    accepts(tool("shellcheck"), *map(str, scripts))


def test_the_containerfile_passes_hadolint() -> None:
    accepts(tool("hadolint"), CONTAINERFILE)


def test_the_crontab_is_valid() -> None:
    table = crontab()
    (job,) = list(table)
    assert job.is_valid() and job.is_enabled()
    assert job.slices.render() == "*/5 * * * *"
    environment = {**table.env, **job.env}
    assert environment["MAILTO"] and environment["NUMBA_CACHE_DIR"] == KERNELS
    assert "%" not in job.command, "cron makes line ends of them"


# ---------------------------------------------------------------- options and exit statuses


def test_every_sweep_command_has_valid_options(workflow: Any) -> None:
    for name, words in sweeps().items():
        made = arguments(workflow.main, words)
        assert (made["inbox"], made["outbox"]) == (INBOX, OUTBOX), name
        # Workers of an external scheduler have one thread each; the default is the thread count of this machine.
        assert made["threads"] == 1, name
        assert (made["workers"] is None) == (made["scheduler"] is not None), name


def test_service_options_can_be_set_in_the_environment_file() -> None:
    assert f"BLOCKSAR_OPTIONS={' '.join(service_command()[2:-2])}" in text("systemd", "inbox.env").splitlines()
    assert "/etc/blocksar/inbox.env" in text("systemd", "README.md")


def test_every_dask_command_has_valid_options() -> None:
    commands_of = {
        "scheduler": distributed.cli.dask_scheduler.main,
        "worker": distributed.cli.dask_worker.main,
    }
    for kind, command in commands_of.items():
        assert isinstance(command, click.Command)
        found = commands(kind)
        assert len(found) == 2  # compose and Kubernetes
        for words in found:
            assert words[:2] == ["dask", kind]
            made = command.make_context(kind, words[2:]).params
            if kind == "worker":
                assert made["nthreads"] == 1


def documented(docstring: str) -> set[int]:
    """Exit statuses in the docstring of the workflow."""
    table = docstring.split("exit status   meaning\n")[1].split("\n\n", maxsplit=1)[0]
    return {int(number) for row in table.splitlines() for number in re.findall(r"\d+", row[:18])}


def test_exit_statuses_match_the_workflow(workflow: Any) -> None:
    known = documented(workflow.__doc__)
    assert known == {
        workflow.DONE, workflow.FAILED, workflow.USAGE, workflow.QUARANTINED, workflow.BUSY, endings.INTERRUPTED,
        endings.TERMINATED,
    }  # fmt: skip
    well = {workflow.BUSY, endings.INTERRUPTED, endings.TERMINATED}  # besides 0
    assert set(map(int, unit(SERVICE)["SuccessExitStatus"][0].split())) == well
    arms = re.findall(r"^([\d |]+)\)", text("cron", "sweep"), re.MULTILINE)
    assert {int(number) for arm in arms for number in arm.split("|")} == known
    job = manifest("CronJob", "inbox")["spec"]["jobTemplate"]["spec"]
    hopeless = {code for r in job["podFailurePolicy"]["rules"] for code in r.get("onExitCodes", {}).get("values", [])}
    assert hopeless == {workflow.USAGE, workflow.QUARANTINED, workflow.BUSY}
    rows = re.findall(r"^\| ([\d, ]+) \|", text("README.md"), re.MULTILINE)
    assert {int(number) for row in rows for number in row.split(",")} == known


def test_stop_timeouts_leave_a_sweep_time_to_end() -> None:
    """Every stop timeout is at least twice the grace period of a sweep."""
    job = manifest("CronJob", "inbox")["spec"]["jobTemplate"]["spec"]["template"]["spec"]
    waits = [unit(SERVICE)["TimeoutStopSec"][0], job["terminationGracePeriodSeconds"]]
    waits += [service["stop_grace_period"].removesuffix("s") for service in compose()["services"].values()]
    waits += re.findall(r"--signal=B:TERM@(\d+)", text("slurm", "focus.sbatch"))
    assert len(waits) == 7
    assert all(int(seconds) >= 2 * endings.GRACE for seconds in waits)


def installation(folder: Path, python: str) -> Path:
    """A stand-in for /opt/blocksar: the files of an image, and a given script as its Python."""
    (folder / ".venv" / "bin").mkdir(parents=True)
    (folder / ".venv" / "bin" / "python").write_text(python)
    (folder / ".venv" / "bin" / "python").chmod(0o755)
    shutil.copytree(ROOT / "workflows" / "inbox", folder / "workflows" / "inbox")
    shutil.copy(ROOT / "workflows" / "process_inbox.py", folder / "workflows")
    (folder / "deploy").symlink_to(ROOT / "deploy")
    return folder


@pytest.mark.parametrize("status", [0, 1, 75, 137])
def test_cron_sends_mail_only_when_attention_is_needed(status: int, tmp_path: Path) -> None:
    home = installation(tmp_path / "opt", f"#!/bin/sh\necho said; echo also >&2; exit {status}\n")
    command = [DEPLOY / "cron" / "sweep", "in", "out"]
    done = subprocess.run(
        command, env={"BLOCKSAR_HOME": str(home), "PATH": os.defpath}, capture_output=True, text=True, check=False
    )
    assert done.returncode == status and not done.stderr
    if status in (0, 75):
        assert not done.stdout
    else:
        assert done.stdout.startswith("said\nalso\n\n") and f"exit status {status}: " in done.stdout


@pytest.mark.slow
def test_the_deployed_command_runs_on_an_empty_inbox(workflow: Any, tmp_path: Path) -> None:
    """The command of cron exits with status 0 and records it in status.json, with no other files of workflows/."""
    quoted = shlex.quote(sys.executable)
    home = installation(tmp_path / "opt", f'#!/bin/sh\nexec {quoted} "$@"\n')
    inbox, outbox = tmp_path / "inbox", tmp_path / "outbox"
    inbox.mkdir()
    made = cron_command()
    for there, here in {"/opt/blocksar": str(home), INBOX: str(inbox), OUTBOX: str(outbox)}.items():
        made = [here + word.removeprefix(there) if word.startswith(there) else word for word in made]
    assert not any(word.startswith(("/opt", "/srv")) for word in made)
    environment = os.environ | {"BLOCKSAR_HOME": str(home), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(made, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == workflow.DONE, done.stdout + done.stderr
    status = json.loads((outbox / "status.json").read_text())
    assert (status["state"], status["exit_status"], status["left"]) == ("ended", 0, 0)


# ---------------------------------------------------------------- consistency between files


def test_all_containers_use_the_image_of_this_version() -> None:
    assert {box.image for box in boxes()} == {IMAGE}
    assert f'image.version="{blocksar.__version__}"' in CONTAINERFILE.read_text()
    (override,) = yaml.safe_load(text("kubernetes", "kustomization.yaml"))["images"]
    assert f"{override['name']}:{override['newTag']}" == IMAGE
    for path in (CONTAINERFILE, DEPLOY / "container" / "README.md", DEPLOY / "kubernetes" / "README.md"):
        assert set(re.findall(r"blocksar:(\d[\w.]*)", path.read_text())) == {blocksar.__version__}


def test_the_image_contains_the_files_it_runs() -> None:
    made = CONTAINERFILE.read_text()
    assert f"COPY workflows/process_inbox.py {WORKFLOW}\n" in made
    assert f"COPY workflows/inbox {Path(WORKFLOW).parent / 'inbox'}\n" in made
    assert f"ENV PATH={Path(PYTHON).parent}:" in made
    for folder in (INBOX, OUTBOX, KERNELS):
        assert re.search(rf"install --directory .*{folder}\b", made.replace("\\\n", "")), folder
    for source in re.findall(r"^COPY (?!--from)(.*) \S+$", made, re.MULTILINE):
        assert all((ROOT / name).exists() for name in source.split())


def test_the_command_that_compiles_the_loops_is_called() -> None:
    """Compose, Kubernetes and the Slurm recipe compile the loops in a separate process."""
    files = [path for path in DEPLOY.rglob("*") if path.suffix in (".py", ".yaml")]
    words = r"blocksar\W+compile\W+--quiet"
    found = {path.name for path in files if re.search(words, path.read_text(encoding="utf-8"))}
    assert found == {"compose.yaml", "cluster.yaml", "focus_on_slurm.py"}


def test_nothing_runs_as_root() -> None:
    (user,) = re.findall(r"^USER (\d+:\d+)$", CONTAINERFILE.read_text(), re.MULTILINE)
    number = int(user.partition(":")[0])
    assert number > 0
    for name, pod in pods().items():
        secured = pod["securityContext"]
        assert (secured["runAsUser"], secured["runAsGroup"], secured["fsGroup"]) == (number,) * 3, name
        assert secured["runAsNonRoot"] and pod["automountServiceAccountToken"] is False
        for made in [*pod.get("initContainers", []), *pod["containers"]]:
            inner = made["securityContext"]
            assert inner["readOnlyRootFilesystem"] and inner["capabilities"] == {"drop": ["ALL"]}
            assert inner["allowPrivilegeEscalation"] is False
    for service in compose()["services"].values():
        assert service["read_only"] and service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges"] and "privileged" not in service
    assert f"--owner {number}" in text("container", "README.md")
    assert unit(SERVICE)["User"] == ["blocksar"]


def test_every_container_has_a_writable_numba_cache() -> None:
    """Without a writable cache numba refuses to load blocksar, in the scheduler as well."""
    assert f"NUMBA_CACHE_DIR={KERNELS}" in CONTAINERFILE.read_text()
    for box in boxes():
        assert KERNELS in box.writable, box.name
    directives = unit(SERVICE)
    assert "NUMBA_CACHE_DIR=%C/blocksar" in directives["Environment"] and directives["CacheDirectory"] == ["blocksar"]


def test_volumes_exist_and_the_inbox_is_read_only() -> None:
    made = compose()
    named = {mount.split(":")[0] for service in made["services"].values() for mount in service["volumes"]}
    assert {name for name in named if not name.startswith("$")} == set(made["volumes"])
    claims = {m["metadata"]["name"] for m in manifests() if m["kind"] == "PersistentVolumeClaim"}
    for pod in pods().values():
        volumes = {volume["name"]: volume for volume in pod["volumes"]}
        assert {v["persistentVolumeClaim"]["claimName"] for v in volumes.values() if "emptyDir" not in v} <= claims
        for box in [*pod.get("initContainers", []), *pod["containers"]]:
            assert {mount["name"] for mount in box["volumeMounts"]} <= set(volumes)
    for box in boxes():
        assert INBOX not in box.writable
        assert box.name not in ("worker", "inbox") or OUTBOX in box.writable
    assert unit(SERVICE)["ReadOnlyPaths"] == [INBOX] and unit(SERVICE)["ReadWritePaths"] == [OUTBOX]
    assert unit(SERVICE)["ProtectSystem"] == ["strict"]


def option(words: list[str], name: str) -> str:
    return words[words.index(name) + 1]


def test_memory_limits_are_consistent() -> None:
    """The limit of a container exceeds the limit of its dask worker by a margin for the nanny."""
    in_compose, in_pod = commands("worker")
    limits = [
        (in_compose, compose()["services"]["worker"]["mem_limit"].replace("m", "MiB")),
        (in_pod, pods()["worker"]["containers"][0]["resources"]["limits"]["memory"] + "B"),
    ]
    for words, limit in limits:
        worker = parse_bytes(option(words, "--memory-limit"))
        assert worker + 0.25 * GIB <= parse_bytes(limit) <= worker + GIB
    directives, words = unit(SERVICE), service_command()
    needed = int(option(words, "--workers")) * parse_bytes(option(words, "--memory-limit")) + GIB
    assert needed <= parse_bytes(directives["MemoryMax"][0] + "iB")
    single = next(block for block in fenced("container") if "podman run" in block)
    assert f"--memory {needed // GIB + 1}g" in single


def test_ports_are_consistent() -> None:
    listening = [commands("scheduler"), commands("worker")]
    for words in listening[0]:
        assert option(words, "--port") == "8786" and option(words, "--dashboard-address").endswith(":8787")
    for words in listening[1]:
        assert option(words, "--worker-port") == "9000" and option(words, "--nanny-port") == "9001"
        assert option(words, "--dashboard-address").endswith(":8788")
    for name, port in (("scheduler", 8787), ("worker", 8788)):
        assert f"http://127.0.0.1:{port}/health" in compose()["services"][name]["healthcheck"]["test"][-1]
        ports = {p["name"]: p["containerPort"] for p in pods()[name]["containers"][0]["ports"]}
        assert ports["http-dashboard"] == port
        assert pods()[name]["containers"][0]["readinessProbe"]["httpGet"] == {
            "path": "/health",
            "port": "http-dashboard",
        }
    service = manifest("DaskCluster", "blocksar")["spec"]["scheduler"]["service"]
    assert {p["port"] for p in service["ports"]} == {8786, 8787}
    allowed = {
        name: {
            port["port"]
            for rule in manifest("NetworkPolicy", name)["spec"].get("ingress", [])
            for port in rule["ports"]
        }
        for name in ("scheduler", "workers", "inbox")
    }
    assert allowed == {"scheduler": {8786, 8787}, "workers": {9000, 9001}, "inbox": set()}
    for spec in (made["spec"] for made in manifests() if made["kind"] == "NetworkPolicy"):
        asked = {port["port"] for rule in spec["egress"] for port in rule["ports"]}
        assert asked <= {53, 8786, 9000, 9001}


def test_the_scheduler_is_not_reachable_from_outside() -> None:
    made = compose()
    assert made["networks"]["cluster"] == {"internal": True}
    assert all(service["networks"] == ["cluster"] and "ports" not in service for service in made["services"].values())
    assert manifest("NetworkPolicy", "nothing-but-names")["spec"]["podSelector"] == {}
    assert manifest("DaskCluster", "blocksar")["spec"]["scheduler"]["service"]["type"] == "ClusterIP"
    assert unit(SERVICE)["IPAddressDeny"] == ["any"] and unit(SERVICE)["IPAddressAllow"] == ["localhost"]


def test_network_policies_select_existing_pods() -> None:
    sweep = manifest("CronJob", "inbox")["spec"]["jobTemplate"]["spec"]["template"]["metadata"]["labels"]
    by_operator = [{"dask.org/cluster-name": "blocksar", "dask.org/component": c} for c in ("scheduler", "worker")]
    there = [sweep, *by_operator]

    def selectors(made: Any) -> Iterator[dict[str, str]]:
        if isinstance(made, dict):
            if "podSelector" in made:
                yield made["podSelector"].get("matchLabels", {})
            for value in made.values():
                yield from selectors(value)
        elif isinstance(made, list):
            for value in made:
                yield from selectors(value)

    for wanted in selectors(manifests()):
        assert any(wanted.items() <= labels.items() for labels in there), wanted


def test_scheduler_addresses_match_the_services() -> None:
    assert {option(words, "--scheduler") for words in commands("inbox")} == {
        "tcp://scheduler:8786",  # service in compose
        f"tcp://{manifest('DaskCluster', 'blocksar')['metadata']['name']}-scheduler:8786",  # service of the operator
    }
    assert "scheduler" in compose()["services"]
    assert "tcp://scheduler:8786" in compose()["services"]["worker"]["command"]


def environment_name(key: str) -> str:
    return f"DASK_{key}".upper().replace(".", "__").replace("-", "_")


class Enough(Exception):
    """Raised to stop a run once the settings have been recorded."""


def test_external_clusters_use_the_settings_of_a_local_cluster(recipe: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The image and the Slurm recipe set by environment variables what `blocksar` sets for its own cluster."""
    own: dict[str, Any] = {}

    def look(*_: Any, **__: Any) -> Any:
        own.update({key: dask.config.get(key) for key in recipe.SETTINGS})
        spawn = dask.config.get("distributed.nanny.pre-spawn-environ")
        own["environment"] = {key: str(spawn[key]) for key in recipe.ENVIRONMENT}
        raise Enough

    monkeypatch.setattr(cluster, "OwnCluster", look)
    monkeypatch.setattr(cluster, "compile_missing", lambda *_: None)
    with pytest.raises(Enough), cluster.open_client():
        pass
    assert own.pop("environment") == recipe.ENVIRONMENT
    assert own == recipe.SETTINGS
    made = CONTAINERFILE.read_text().replace("\\\n", "")
    (line,) = re.findall(r"^ENV (.*)$", made, re.MULTILINE)
    image = dict(word.split("=", 1) for word in line.split())
    wanted = {environment_name(key): value for key, value in recipe.SETTINGS.items()} | recipe.ENVIRONMENT
    assert set(wanted) <= set(image)
    read = dask.config.collect_env(image)
    with dask.config.set(config={}):
        for key, value in recipe.SETTINGS.items():
            assert dask.config.get(key, config=read) == value, key
    assert {key: image[key] for key in recipe.ENVIRONMENT} == recipe.ENVIRONMENT


def test_the_base_image_has_a_supported_python() -> None:
    bases = re.findall(r"python:(\d+\.\d+)", CONTAINERFILE.read_text())
    assert bases and all(version in SpecifierSet(PROJECT["requires-python"]) for version in bases)
    for part in ("systemd", "cron", "slurm"):
        assert set(re.findall(r"python(3\.\d+) -m venv", text(part, "README.md"))) == set(bases)
    for name in ("requirements.txt", "requirements-build.txt"):
        assert f"--python-version {bases[0]} " in text("container", name)


def locked(name: str) -> dict[str, str]:
    """Locked versions by name; every entry must have file hashes."""
    found = {}
    for entry in re.split(r"\n(?=\w)", text("container", name)):
        if "==" in (first := entry.splitlines()[0]):
            requirement, version = first.split(" ")[0].split("==")
            assert "--hash=sha256:" in entry, requirement
            found[requirement.lower()] = version
    return found


def test_every_dependency_is_locked() -> None:
    versions, made = locked("requirements.txt"), text("container", "requirements.txt")
    extras = re.findall(r"--extra (\w+)", made.splitlines()[1])
    (said,) = re.findall(r"extras(.*?), so", text("container", "README.md"), re.DOTALL)
    assert extras == re.findall(r"`(\w+)`", said)
    wanted = PROJECT["dependencies"] + [name for extra in extras for name in PROJECT["optional-dependencies"][extra]]
    hint = f"make {made.splitlines()[0]} anew by the command in its second line"
    for requirement in map(Requirement, wanted):
        assert versions.get(requirement.name.lower()) in requirement.specifier, hint
    system = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["build-system"]
    for requirement in map(Requirement, system["requires"]):
        assert locked("requirements-build.txt")[requirement.name] in requirement.specifier


# ---------------------------------------------------------------- Slurm


def focus_on_slurm(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(FOCUS_ON_SLURM), *words]
    return subprocess.run(command, env=environment, cwd=cwd, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_the_job_script_of_a_worker(tmp_path: Path) -> None:
    pytest.importorskip("dask_jobqueue")
    words = (
        "ph.zarr",
        "--out",
        "run",
        "--job-script",
        "--memory",
        "2GiB",
        "--walltime",
        "00:20:00",
        "--queue",
        "radar",
    )
    done = focus_on_slurm(*words, "--directive=--constraint=avx512", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    script = done.stdout
    directives = set(re.findall(r"^#SBATCH (.*)$", script, re.MULTILINE))
    assert {"-n 1", "--cpus-per-task=1", "--mem=2560M", "-t 00:20:00", "-p radar", "--constraint=avx512"} <= directives
    assert "export NUMBA_NUM_THREADS=1\n" in script
    *_, compiling, worker = script.strip().splitlines()
    assert shlex.split(compiling) == [sys.executable, "-m", "blocksar", "compile", "--quiet"]
    words_of_worker = shlex.split(worker.replace("${TMPDIR:-/tmp}", "/tmp"))
    assert words_of_worker[:3] == [sys.executable, "-m", "distributed.cli.dask_worker"]
    folder = tmp_path / "run.slurm"
    folder.joinpath("pem").touch()  # the certificates were removed when the process ended
    words_of_worker = [str(folder / "pem") if "/.dask-jobqueue." in word else word for word in words_of_worker]
    made = distributed.cli.dask_worker.main.make_context("worker", words_of_worker[3:]).params
    assert made["nthreads"] == 1 and parse_bytes(made["memory_limit"]) == 2 * GIB
    assert made["scheduler"].startswith("tls://") and made["tls_key"] and not made["dashboard"]
    (tmp_path / "job.sh").write_text(script)
    accepts(tool("shellcheck"), "--severity=error", tmp_path / "job.sh")


@pytest.mark.slow
def test_wrong_input_is_reported_before_any_job_is_submitted(tmp_path: Path) -> None:
    pytest.importorskip("dask_jobqueue")
    done = focus_on_slurm("nowhere.zarr", "--out", "run", cwd=tmp_path)
    assert done.returncode == endings.WRONG_INPUT and "nowhere.zarr" in done.stderr
    assert not list(tmp_path.iterdir())


def test_the_batch_script_calls_the_recipe(recipe: Any, tmp_path: Path) -> None:
    script = DEPLOY / "slurm" / "focus.sbatch"
    home = installation(tmp_path / "opt", '#!/bin/sh\nfor word; do echo "$word"; done\n')
    environment = {"BLOCKSAR_HOME": str(home), "PATH": os.defpath}
    call = ["bash", script, "a b.zarr", "run", "--jobs", "8", "--queue", "compute"]
    done = subprocess.run(call, env=environment, capture_output=True, text=True, check=True)
    program, *words = done.stdout.splitlines()
    assert Path(program).resolve() == FOCUS_ON_SLURM
    made = arguments(recipe.main, words)
    assert (made["source"], made["out"], made["jobs"], made["queue"]) == ("a b.zarr", "run", 8, "compute")
    assert (
        subprocess.run(["bash", script, "a"], env=environment, stderr=subprocess.DEVNULL, check=False).returncode == 2
    )
    examples = [block for block in fenced("slurm") if "focus.sbatch" in block or "focus_on_slurm.py" in block]
    lines = [line for line in "\n".join(examples).replace("\\\n", " ").splitlines() if line]
    assert len(lines) == 2
    for line in lines:
        words = shlex.split(line)
        start = next(i for i, word in enumerate(words) if "/deploy/slurm/" in word)
        rest = words[start + 1 :]
        if words[0] == "sbatch":
            rest = [rest[0], "--out", *rest[1:]]
        assert arguments(recipe.main, rest)["jobs"] == 8


# ---------------------------------------------------------------- documentation


def test_files_named_in_readmes_exist() -> None:
    for part in PARTS:
        readme = text(part, "README.md")
        for name in re.findall(r"\bdeploy/[\w./-]*\w", readme):
            assert (ROOT / name).exists(), f"{part}: {name}"
        for name in re.findall(r"(?<![/\w.@%-])[\w-]+\.(?:conf|service|timer|env|yaml|sbatch|crontab|txt)\b", readme):
            beside = [p.name for p in DEPLOY.rglob("*")]
            assert name in beside, f"{part}: {name}"
