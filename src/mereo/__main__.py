"""``mereo`` and ``python -m mereo``: run one command, and answer what a user can cause with one line."""

import importlib.metadata
import os
import sys

TRACEBACK_VARIABLE = "MEREO_TRACEBACK"
USER_ERROR, INTERRUPTED, BROKEN_PIPE = 2, 130, 141
"""Exit codes; the last two are 128 plus the signal's number, as shells report them."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code. With MEREO_TRACEBACK=1 errors are raised as they are."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments in (["--version"], ["-V"]):
        print(f"mereo {version()}")
        return 0
    try:
        from mereo.commands import parse

        parse(arguments).run()
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _stop("mereo: interrupted", INTERRUPTED)
    except BrokenPipeError:
        # the reader (head, less) has gone; without this, flushing at exit would complain again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except (ValueError, OSError, ImportError) as error:
        if os.environ.get(TRACEBACK_VARIABLE) == "1":
            raise
        return _stop(f"mereo: error: {one_line(error)}", USER_ERROR)
    return 0


def version() -> str:
    """The installed version."""
    try:
        return importlib.metadata.version("mereo")
    except importlib.metadata.PackageNotFoundError:
        return "(not installed)"


def one_line(error: Exception) -> str:
    """The error's sentence; for an error of the operating system its file and reason."""
    if isinstance(error, OSError) and error.strerror:
        reason = error.strerror[0].lower() + error.strerror[1:]
        place = f"{error.filename}: " if error.filename else ""
        return f"{place}{reason}: correct that and run the same command again"
    return " ".join(str(error).split()) or type(error).__name__


def _stop(message: str, code: int) -> int:
    sys.stdout.flush()
    print(message, file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
