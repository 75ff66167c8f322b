"""Files that survive a crash: written completely or not at all, appended to and cut back, locked."""

import contextlib
import fcntl
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

LOCK, PARTIAL = ".lock", ".partial"


def write(path: Path, data: bytes) -> None:
    """Write a file under a temporary name and rename it, so that it is never seen half-written."""
    partial = path.with_name(f".{path.name}{PARTIAL}")
    try:
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def is_unused(path: Path) -> bool:
    """Return whether nothing is there, or a folder with no more than a process leaves that was killed as it began."""
    if not os.path.lexists(path):
        return True
    return path.is_dir() and all(found.name == LOCK or found.match(f".*{PARTIAL}") for found in path.iterdir())


def check_place(path: Path) -> None:
    """Check that a file can be written by writing another beside it, since permissions alone do not tell.

    Raises:
        OSError: if it cannot.
    """
    if not path.parent.is_dir():
        problem = "is not a folder" if path.parent.exists() else "does not exist"
        raise OSError(f"{path} cannot be written: {path.parent} {problem}")
    try:
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}."):
            pass
    except OSError as error:
        raise OSError(f"{path} cannot be written: {error.strerror}") from None


def check_ending(path: Path, endings: Sequence[str], flag: str = "--output") -> None:
    """Check that a file has one of the endings that are known.

    Raises:
        ValueError: if it has not.
    """
    if path.suffix not in endings:
        raise ValueError(f"{flag} {path} must end in {'one of ' * (len(endings) > 1)}{', '.join(endings)}")


def check_free(path: Path, *, overwrite: bool, is_folder: bool = False) -> Path:
    """Check that an output can be written without loss, before it is computed.

    Args:
        path: where it is to go.
        overwrite: whether it may replace what is there.
        is_folder: whether it is a folder; else it is a file.

    Returns:
        Path: where to write it: in place of a link, its target.

    Raises:
        FileExistsError: if something is there that is not an empty folder, unless `overwrite`.
        OSError: if it cannot be written there.
    """
    if os.path.lexists(path) and not overwrite and not (is_folder and path.is_dir() and not any(path.iterdir())):
        raise FileExistsError(f"{path} already exists; pass --overwrite to replace it")
    if path.exists() and path.is_dir() != is_folder:
        raise FileExistsError(f"{path} is a {'file' if path.is_file() else 'folder'}; choose another --output")
    target = Path(os.path.realpath(path))
    check_place(target)
    return target


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file."""
    write(path, (json.dumps(content, indent=2) + "\n").encode())


def digest(data: bytes) -> str:
    """Return the SHA-256 in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def one_line(error: BaseException) -> str:
    """Return the message of an error without line breaks, with the file that an OSError names."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return " ".join(str(error).split()) or type(error).__name__


@contextlib.contextmanager
def lock(folder: Path) -> Iterator[None]:
    """Keep other processes out of a folder until the block or the process ends, however it ends.

    Raises:
        BlockingIOError: if another process holds it.
    """
    path = folder / LOCK
    with contextlib.ExitStack() as held:
        while True:
            file = held.enter_context(path.open("a+"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                raise BlockingIOError(f"{folder} is in use by process {file.read().strip() or '(number unknown)'}") from None
            if _is_at(path, file):
                break  # and not a file that its last owner has removed meanwhile
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        try:
            yield
        finally:
            if _is_at(path, file):  # and not one that another process has made since
                path.unlink(missing_ok=True)


def _is_at(path: Path, file: IO[str]) -> bool:
    """Return whether an open file is still the one at a path."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


class Log:
    """A file that rows are appended to.

    Args:
        path: the file.
        mark: what `mark` returned when the file had the content to return to; None starts a new file.

    Raises:
        ValueError: if the file no longer begins with that content.
    """

    def __init__(self, path: Path, mark: Mapping[str, Any] | None = None):
        self.path = path
        self._digest = hashlib.sha256()
        if mark:
            self._digest.update(beginning(path, mark))
            self._file = path.open("r+b")
            self._file.truncate(mark["size"])
            self._file.seek(mark["size"])
        else:
            self._file = path.open("wb")

    def append(self, data: bytes) -> None:
        """Add bytes; the operating system has them when this returns.

        Raises:
            OSError: if they cannot be written; the error names the file.
        """
        try:
            self._file.write(data)
            self._file.flush()
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from None
        self._digest.update(data)

    def mark(self) -> dict[str, Any]:
        """Put what was appended on the disk; return what `Log` needs to cut the file back to this length."""
        os.fsync(self._file.fileno())
        return {"size": self._file.tell(), "sha256": self._digest.hexdigest()}

    def close(self) -> None:
        """Close the file; what could not be written is lost."""
        with contextlib.suppress(OSError):
            self._file.close()


def beginning(path: Path, mark: Any) -> bytes:
    """Return what a file held when it was marked.

    Raises:
        ValueError: if it no longer holds it.
    """
    size = mark.get("size") if isinstance(mark, Mapping) else None
    if not isinstance(size, int):
        raise ValueError(f"{path.name} is not in its manifest")
    if not path.is_file():
        raise ValueError(f"{path.name} is missing")
    with path.open("rb") as file:
        data = file.read(min(size, path.stat().st_size))
    if digest(data) != mark.get("sha256"):
        raise ValueError(f"{path.name} has changed since")
    return data


def expect(holds: bool, otherwise: str) -> None:
    """Check something about the content of a file.

    Raises:
        ValueError: if it does not hold.
    """
    if not holds:
        raise ValueError(otherwise)
