"""The command line: a lazy group of commands, and one exit path for all errors."""

from __future__ import annotations

import os
import sys
import warnings
from typing import Any, NoReturn

import click
from click.shell_completion import get_completion_class

from labpipe import __version__
from labpipe.cli.output import echo, message_line
from labpipe.errors import ConfigErrors, LabpipeError, shorten
from labpipe.registry import Registry, nearest

# Matrices are small: one thread is faster, and results do not depend on the number of processors.
for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")


# Faults of one file that are printed one by one.
MOST_FAULTS = 40
INTERRUPTIONS = (KeyboardInterrupt, click.Abort)
DEBUG = "--debug"
INTERRUPTED = "interrupted; nothing was changed"
COMMANDS = Registry("command")


class LazyGroup(click.Group):
    """Imports a command only when it is called, so that --help is quick."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 (click's signature)
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        if cmd_name not in COMMANDS:
            raise click.UsageError(f"no command '{cmd_name}'; {nearest(cmd_name, COMMANDS)}")
        command: click.Command = COMMANDS.load(cmd_name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        rows = []
        for name in COMMANDS:
            words = COMMANDS.words(name)
            rows.append((name, words or COMMANDS.load(name).get_short_help_str(limit=100)))
        with formatter.section("Commands"):
            formatter.write_dl(rows)


def _print_version(context: click.Context, _option: click.Parameter, asked: bool) -> None:
    if asked:
        from labpipe.artefacts.header import version_text

        echo(f"labpipe, version {version_text()}")
        context.exit()


@click.command(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_version,
    help="Show version and commit.",
)
@click.option(
    DEBUG,
    is_flag=True,
    expose_value=False,
    help="Print the traceback of a fault of labpipe itself; at any place.",
)
def group() -> None:
    """From recorded test-rig runs to stiffness and damping with their uncertainty.

    \b
    labpipe run pipelines/pedestal.yaml -o out/pedestal
    """


def main() -> NoReturn:
    """Run the command line and end with exit code 0 (done), 1 (a rule fails), 2 (not done) or 3 (a fault of
    labpipe itself).
    """
    try:
        sys.exit(_run([argument for argument in sys.argv[1:] if argument != DEBUG]))
    except INTERRUPTIONS:
        code = _fail(INTERRUPTED)
        sys.stdout.flush()
        sys.stderr.flush()
        # Where Ctrl-C met an exec() of text, as dataclasses use when they are imported, Python would end by
        # the signal in spite of all.
        os._exit(code)
    except Exception as error:
        sys.exit(_own_fault(error))


def run_command(arguments: list[str]) -> int:
    """The exit code of one command; errors of the input go to standard error as one readable message."""
    try:
        return _run(arguments)
    except INTERRUPTIONS:
        return _fail(INTERRUPTED)


def _run(arguments: list[str]) -> int:
    warnings.showwarning = _echo_warning
    try:
        outcome: Any = group.main(arguments, prog_name="labpipe", standalone_mode=False)
        sys.stdout.flush()
    except click.exceptions.Exit as stop:
        return stop.exit_code
    except click.UsageError as error:
        command = f"{error.ctx.command_path} --help" if error.ctx else "labpipe --help"
        return _fail(f"{error.format_message().rstrip('.')}; see '{command}'")
    except click.ClickException as error:
        return _fail(error.format_message())
    except LabpipeError as error:
        faults = error.faults if isinstance(error, ConfigErrors) else (error,)
        return _fail(*(str(fault) for fault in faults))
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except MemoryError:
        hint = "check lengths, rates and block sizes, or use fewer processes"
        return _fail(f"there is not enough memory for this; {hint}")
    except OSError as error:
        if error.errno is None:
            raise
        return _fail(f"{error.filename or 'output'}: {os.strerror(error.errno).lower()}")
    return outcome if isinstance(outcome, int) else 0


def _own_fault(error: Exception) -> int:
    from tempfile import NamedTemporaryFile
    from traceback import format_exception

    package = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
    if package not in ("", "labpipe"):
        return _fail(f"the package {package} is not installed; `labpipe doctor` lists what is missing")
    text = "".join(format_exception(error))
    place = "the traceback above"
    if DEBUG not in sys.argv:
        try:
            with NamedTemporaryFile(
                "w", prefix="labpipe-fault-", suffix=".txt", delete=False, encoding="utf-8"
            ) as file:
                file.write(f"labpipe {__version__}, Python {sys.version}\n{sys.argv}\n\n{text}")
            place, text = file.name, ""
        except OSError:
            pass
    echo(text, err=True, nl=False)
    words = "; ".join((f"{type(error).__name__}: {error}", *getattr(error, "__notes__", ())))
    what = f"error: this is a fault of labpipe, not of your files ({shorten(words, 200)})"
    echo(message_line(f"{what}; please report it with {place}"), err=True)
    return 3


def _echo_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    """A warning of a library as one line, without the place in its source.

    What will change in a later version as a note.
    """
    is_note = category is FutureWarning
    text = f"note: {message}" if is_note else f"warning: {message} ({category.__name__})"
    echo(message_line(text), err=True)


def _fail(*messages: str) -> int:
    for message in messages[:MOST_FAULTS]:
        echo(message_line(f"error: {message}"), err=True)
    if len(messages) > MOST_FAULTS:
        echo(f"error: and {len(messages) - MOST_FAULTS} more faults of this kind", err=True)
    return 2


SHELLS = {"bash": "~/.bashrc", "zsh": "~/.zshrc", "fish": "~/.config/fish/completions/labpipe.fish"}


@click.command()
@click.argument("shell", type=click.Choice(list(SHELLS)))
def completion(shell: str) -> None:
    """Print the script that lets SHELL complete commands and options of labpipe with the Tab key.

    \b
    bash: eval "$(labpipe completion bash)"       in ~/.bashrc
    zsh:  eval "$(labpipe completion zsh)"        in ~/.zshrc
    fish: labpipe completion fish > ~/.config/fish/completions/labpipe.fish
    """

    completion_class = get_completion_class(shell)
    assert completion_class is not None
    echo(completion_class(group, {}, "labpipe", "_LABPIPE_COMPLETE").source())
