"""SLURM on this machine: munged, slurmctld and slurmd of a test, on the loopback interface, in a folder of their own.

``apt-get install slurm-wlm munge`` installs what is needed. Root or any user can start it.
"""

import getpass
import os
import re
import secrets
import shutil
import socket
import subprocess
import tempfile
import time
from pathlib import Path

CONFIGURATION = """
ClusterName=test
SlurmctldHost=localhost(127.0.0.1)
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SlurmdParameters=config_overrides
MpiDefault=none
KillWait=2
NodeName=localhost NodeAddr=127.0.0.1 NodeHostname={host} CPUs={cpus} RealMemory=200000
PartitionName=compute Nodes=localhost Default=YES MaxTime=INFINITE State=UP
"""
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch")
PATH = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin"])


def is_installed() -> bool:
    """Whether the programs of SLURM are there."""
    return all(shutil.which(name, path=PATH) for name in PROGRAMS)


class SlurmMachine:
    """A cluster of one node. Its CPUs are only counted: more than the machine has are fine for models that wait.

    Parameters
    ----------
    cpus : int
        CPUs that jobs can ask for.

    Attributes
    ----------
    environment : dict
        Environment in which ``sbatch`` and the other commands find this cluster.
    """

    def __init__(self, cpus: int = 8):
        self.folder = Path(tempfile.mkdtemp(prefix="slurm"))  # a short path: that of a socket is limited
        self.folder.chmod(0o755)  # munged insists
        for name in ("state", "spool"):
            (self.folder / name).mkdir()
        text = CONFIGURATION.format(
            user=getpass.getuser(), folder=self.folder, ports=_free_ports(2), host=socket.gethostname(), cpus=cpus
        )
        (self.folder / "slurm.conf").write_text(text)
        key = self.folder / "munge.key"
        key.write_bytes(secrets.token_bytes(128))
        key.chmod(0o600)
        self.environment = os.environ | {"SLURM_CONF": str(self.folder / "slurm.conf"), "PATH": PATH}
        self._running: dict[str, subprocess.Popen] = {}

    def __enter__(self) -> "SlurmMachine":
        files = {"socket": "munge.socket", "key-file": "munge.key", "pid-file": "munged.pid", "seed-file": "munge.seed"}
        self._start("munged", "--foreground", *(f"--{option}={self.folder / name}" for option, name in files.items()))
        self.start_controller()
        self._start("slurmd", "-D", "-N", "localhost")
        self.wait_until(lambda: "idle" in self.run("sinfo", "-h", "-o", "%T", check=False))
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.run("scancel", "--full", f"--user={getpass.getuser()}", check=False)
            self.wait_until(lambda: not self.jobs("RUNNING,COMPLETING"), 30.0)
        finally:
            for process in reversed(self._running.values()):
                process.kill()
                process.wait()
            shutil.rmtree(self.folder, ignore_errors=True)

    def _start(self, name: str, *arguments: str) -> None:
        with open(self.folder / f"{name}.log", "ab") as log:
            command = [shutil.which(name, path=PATH), *arguments]
            self._running[name] = subprocess.Popen(command, env=self.environment, stdout=log, stderr=log)

    def start_controller(self) -> None:
        """Start slurmctld, which continues from the files of the last one."""
        self._start("slurmctld", "-D")
        self.wait_until(lambda: "UP" in self.run("scontrol", "ping", check=False))

    def kill_controller(self) -> None:
        """Kill slurmctld by -9; jobs go on."""
        self._running["slurmctld"].kill()
        self._running["slurmctld"].wait()

    def run(self, *command: str, folder: Path | None = None, check: bool = True) -> str:
        """Standard output and errors of a command."""
        done = subprocess.run(
            command, env=self.environment, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        assert done.returncode == 0 or not check, done.stdout
        return done.stdout

    def jobs(self, states: str = "all") -> dict[int, str]:
        """States of the jobs by their numbers."""
        lines = self.run("squeue", "-h", "-t", states, "-o", "%i %T", check=False).splitlines()
        return {int(line.split()[0]): line.split()[1] for line in lines if re.fullmatch(r"\d+ [A-Z_]+", line)}

    @staticmethod
    def wait_until(condition: object, seconds: float = 60.0) -> None:
        """Wait until a condition holds; AssertionError if it never does."""
        stop = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < stop, "the condition never holds"
            time.sleep(0.2)


def _free_ports(number: int) -> list[int]:
    sockets = [socket.socket() for _ in range(number)]
    try:
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]
    finally:
        for each in sockets:
            each.close()
