"""What only some operating systems have stays in one module."""

import re

from tests.architecture.source import ROOT, imported_names, source_texts

HOME = ROOT / "shinypartial/io/system.py"
MODULES = {"fcntl", "grp", "msvcrt", "posix", "pty", "pwd", "resource", "select", "termios", "tty", "winreg"}
NAMES = re.compile(
    r"os\.(?:fork\w*|getuid|geteuid|kill|killpg|setsid|mkfifo|nice|uname|sched_\w+|getloadavg)\b"
    r"|signal\.(?:SIGKILL|SIGALRM|SIGUSR\d|SIGCHLD|SIGHUP|alarm|setitimer|pthread_\w+)\b"
    r"|preexec_fn|start_new_session|sys\.platform|os\.name\b|[\"']/(?:proc|dev|tmp|etc)/"
)
#: Kernels import no other room, and look whether it is there.
ALLOWED = {ROOT / "panoless/kernels/cpu/workers.py": {"os.sched_getaffinity"}}


def of_some_systems(source: str) -> set[str]:
    return imported_names(source) & MODULES | {match[0] for match in NAMES.finditer(source)}


def test_only_one_module_asks_which_system_runs() -> None:
    found = {path: of_some_systems(source) for path, source in source_texts().items() if path != HOME}
    assert {path: names for path, names in found.items() if names - ALLOWED.get(path, set())} == {}


def test_such_names_would_be_seen() -> None:
    source = "import fcntl.x\nfrom resource import a\nopen('/proc/stat')\nos.fork()\nsignal.signal(signal.SIGINT, b)\n"
    assert of_some_systems(source) == {"fcntl", "resource", "'/proc/", "os.fork"}
