"""A Dockerfile read into its instructions, and carried out in a root file system of its own where no engine is at hand.

The root file system holds the programs of this machine's /usr, read-only, and this Python's installation at /usr/local
as the official image has it; all else is empty or made by the instructions. Needs root, `unshare` and `chroot`.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
ACCOUNTS = "root:x:0:0:root:/root:/bin/sh\n"
DEVICES = ("null", "zero", "random", "urandom")
PASSED_ON = re.compile(
    r"PIP_(INDEX_URL|CERT|DEFAULT_TIMEOUT|FIND_LINKS)|SSL_CERT_FILE|https?_proxy|no_proxy", re.IGNORECASE
)
MOUNTS = """
set -e
cd "$1"
mount --bind /usr usr && mount -o remount,bind,ro usr
mount --bind "$2" usr/local && mount -o remount,bind,ro usr/local
mount -t proc proc proc
mount -t tmpfs tmpfs dev/shm
for device in null zero random urandom; do mount --bind "/dev/$device" "dev/$device"; done
shift 2
exec chroot "$@"
"""


def instructions(path=ROOT / "Dockerfile"):
    """(word, rest) of every instruction, lines that are continued joined and comments left out."""
    lines = [line for line in path.read_text().splitlines() if not line.lstrip().startswith("#")]
    text = "\n".join(lines).replace("\\\n", " ")
    return [tuple(line.split(maxsplit=1)) for line in text.splitlines() if line.strip()]


def why_no_root():
    """Why no root file system can be made here; empty where one can."""
    if os.geteuid() != 0:
        return "only root can make a root file system of its own"
    if not all(map(shutil.which, ("unshare", "chroot", "mount"))):
        return "needs unshare, chroot and mount"
    probe = ["unshare", "--mount", "--pid", "--fork", "mount", "-t", "tmpfs", "tmpfs", "/mnt"]
    return "" if subprocess.run(probe, capture_output=True).returncode == 0 else "this machine lets nobody mount"


def stop(process):
    """End in good order what a stage's command line has started; `unshare` itself ignores the signal."""
    (child,) = map(int, Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split())
    os.kill(child, signal.SIGTERM)
    process.wait(60)


class Stage:
    """One stage of an image: its folder, and what its instructions have set."""

    def __init__(self, folder):
        self.folder, self.user, self.workdir = folder, "0", "/"
        self.env = {name: value for name, value in os.environ.items() if PASSED_ON.fullmatch(name)}
        self.env |= {"PATH": "/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin", "HOME": "/root"}
        self.said = {}
        for name in ("usr", "proc", "dev/shm", "etc/ssl", "tmp", "root", "var"):
            (folder / name).mkdir(parents=True)
        for name in ("bin", "sbin", "lib", "lib64"):
            (folder / name).symlink_to(f"usr/{name}")
        for name in DEVICES:
            (folder / "dev" / name).touch()
        (folder / "tmp").chmod(0o1777)
        (folder / "etc/passwd").write_text(ACCOUNTS)
        (folder / "etc/group").write_text("root:x:0:\n")
        (folder / "etc/ld.so.conf").write_text("/usr/local/lib\n")
        shutil.copy("/etc/resolv.conf", folder / "etc")
        shutil.copytree("/etc/ssl/certs", folder / "etc/ssl/certs", symlinks=False, ignore_dangling_symlinks=True)
        for shared in filter(Path.is_dir, map(Path, os.environ.get("PIP_FIND_LINKS", "").split())):
            (folder / str(shared).lstrip("/")).mkdir(parents=True)  # what pip is told to look into may be empty here
        self.run(["/sbin/ldconfig"])  # or this Python would load the library of another

    def command(self, words):
        """The command line that runs `words` inside."""
        inside = [
            "--userspec",
            f"{self.user}:{self.user}",
            str(self.folder),
            "/usr/bin/env",
            "-i",
            f"--chdir={self.workdir}",
        ]
        settings = [f"{name}={value}" for name, value in self.env.items()]
        shell = ["unshare", "--mount", "--pid", "--fork", "sh", "-c", MOUNTS, "sh", str(self.folder)]
        return [*shell, sys.base_prefix, *inside, *settings, *words]

    def run(self, words, timeout=900):
        """Run `words` inside, to their end; what they print."""
        done = subprocess.run(self.command(words), capture_output=True, text=True, timeout=timeout)
        assert done.returncode == 0, f"{words}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
        return done.stdout

    def copy(self, words, stages):
        """COPY: from the checkout or from a stage before."""
        source, names = ROOT, words[:-1]
        if words[0].startswith("--from="):
            source, names = stages[words[0].removeprefix("--from=")].folder, words[1:-1]
        for name in names:
            origin, target = source / name.lstrip("/"), self.folder / words[-1].lstrip("/")
            if words[-1].endswith("/"):
                target = target / origin.name
            target.parent.mkdir(parents=True, exist_ok=True)
            if origin.is_dir():
                shutil.copytree(
                    origin,
                    target,
                    symlinks=True,
                    ignore=shutil.ignore_patterns("__pycache__") if source == ROOT else None,
                )
            else:
                shutil.copy(origin, target)

    def set(self, text):
        """ENV: NAME=VALUE words."""
        self.env |= dict(word.split("=", 1) for word in text.split())

    def use(self, name):
        """USER: a number or a name of /etc/passwd."""
        rows = [row.split(":") for row in (self.folder / "etc/passwd").read_text().splitlines()]
        self.user = next((row[2] for row in rows if row[0] == name), name)

    def enter(self, name):
        """WORKDIR: made where it is not there."""
        self.workdir = name
        (self.folder / name.lstrip("/")).mkdir(parents=True, exist_ok=True)


def carried_out(folder):
    """The last stage, all its instructions carried out in `folder`."""
    stages, stage = {}, None
    for word, rest in instructions():
        if word == "FROM":
            name = rest.split(" AS ")[1] if " AS " in rest else str(len(stages))
            stages[name] = stage = Stage(folder / name)
        elif word == "RUN":
            stage.run(["/bin/sh", "-c", rest])
        elif word == "COPY":
            stage.copy(rest.split(), stages)
        elif word == "ENV":
            stage.set(rest)
        elif word == "USER":
            stage.use(rest)
        elif word == "WORKDIR":
            stage.enter(rest)
        elif word in ("ENTRYPOINT", "CMD"):
            stage.said[word] = json.loads(rest)
        elif word == "HEALTHCHECK":
            stage.said[word] = json.loads(rest.split(" CMD ")[1])
        else:
            assert word in ("ARG", "LABEL", "EXPOSE", "VOLUME"), f"{word}: not known here"
    return stage
