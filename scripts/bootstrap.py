"""Make .venv with the pinned packages, and say clearly what the machine lacks; with --peers also .venv/peers, for `make bench`.

Runs under the system's python3, whatever its age: plain syntax, standard library only.
"""

import hashlib
import os
import shutil
import subprocess
import sys

SUPPORTED = ("3.13", "3.12", "3.11")
HERE = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
VENV = os.path.join(HERE, ".venv")
VENV_PYTHON = os.path.join(VENV, "bin", "python")
STAMP = os.path.join(VENV, ".ready")
LOCK = "requirements/lock.txt"
PEERS, PEERS_LOCK = os.path.join(VENV, "peers"), "requirements/peers.txt"
DECIDING = [LOCK, "setup.py", "setup.cfg", "pyproject.toml", "scripts/bootstrap.py"]


def fail(problem, remedy):
    """Print one clear message and stop."""
    sys.exit(f"\nbrainshift_ros cannot be set up: {problem}\n  -> {remedy}\n")


def version_of(python):
    """Major.minor of an interpreter, empty if it does not run."""
    probe = "import sys; print('%d.%d' % sys.version_info[:2])"
    return subprocess.run([python, "-c", probe], stdout=subprocess.PIPE, text=True, check=False).stdout.strip()


def find_python():
    """Path of a supported interpreter, the running one first."""
    for name in [sys.executable, *(f"python{version}" for version in SUPPORTED)]:
        path = shutil.which(name)
        if path and version_of(path) in SUPPORTED:
            return path
    return fail(
        f"no supported Python ({' or '.join(SUPPORTED)}) on PATH; python3 is {version_of(sys.executable)}",
        "install one (Debian 12 has 3.11, Debian 13 has 3.13, Ubuntu 24.04 has 3.12), or put one on PATH",
    )


def fingerprint():
    """Hash of all that decides what .venv must hold, and of where it lies (an environment cannot be moved)."""
    sha = hashlib.sha256(HERE.encode())
    for name in DECIDING:
        with open(os.path.join(HERE, name), "rb") as stream:
            sha.update(stream.read())
    return sha.hexdigest()


def run(command, problem, remedy="see the lines above"):
    """Run a command with its output shown; stop with a clear message if it fails."""
    if subprocess.run(command, cwd=HERE, check=False).returncode != 0:
        fail(problem, remedy)


def set_up_peers():
    """Make .venv/peers unless it is already as wanted; a bench without it says what it leaves out."""
    stamp = os.path.join(PEERS, ".ready")
    with open(os.path.join(HERE, PEERS_LOCK)) as stream:
        wanted = stream.read()
    if os.path.exists(stamp):
        with open(stamp) as stream:
            if stream.read() == wanted:
                return
    print("Setting up .venv/peers (packages are downloaded once) ...", flush=True)
    run([VENV_PYTHON, "-m", "venv", "--clear", PEERS], "the environment of the peers could not be made")
    python = os.path.join(PEERS, "bin", "python")
    install = [python, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-deps", "-r", PEERS_LOCK]
    run(install, "pip could not install the peers")
    with open(stamp, "w") as stream:
        stream.write(wanted)


def main():
    """Set up .venv unless it is already as wanted."""
    wanted = fingerprint()
    if os.path.exists(STAMP):
        with open(STAMP) as stream:
            if stream.read() == wanted:
                return
    python = find_python()
    if subprocess.run([python, "-c", "import venv, ensurepip"], stderr=subprocess.DEVNULL, check=False).returncode != 0:
        fail("Python lacks venv or pip", "on Debian or Ubuntu: apt-get install python3-venv python3-pip")
    print(f"Setting up .venv with {python} (packages are downloaded once) ...", flush=True)
    if not os.path.exists(VENV_PYTHON) or version_of(VENV_PYTHON) not in SUPPORTED:
        run([python, "-m", "venv", "--clear", VENV], "the virtual environment could not be made")
    install = [VENV_PYTHON, "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    # The lock is complete, so pip's resolver, which can search for minutes, has nothing to do.
    run(
        [*install, "--no-deps", "-r", LOCK],
        "pip could not install the pinned packages",
        "see pip's message above; the packages come from PyPI, and the ROS wheels exist for x86-64 Linux only",
    )
    run(
        [*install, "--no-deps", "--no-build-isolation", "--editable", HERE],
        "the package itself could not be installed",
    )
    with open(STAMP, "w") as stream:
        stream.write(wanted)


if __name__ == "__main__":
    main()
    if "--peers" in sys.argv[1:]:
        set_up_peers()
