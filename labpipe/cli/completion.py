"""labpipe completion SHELL"""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from labpipe.cli.output import echo

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
    from labpipe.cli.main import group

    completion_class = get_completion_class(shell)
    assert completion_class is not None
    echo(completion_class(group, {}, "labpipe", "_LABPIPE_COMPLETE").source())
