"""``rotorwatch webhook``: creates secrets, and tests whether a receiver can be reached."""

from pathlib import Path
from typing import Annotated

import typer

from models.errors import MachineFileError

commands = typer.Typer(name="webhook", no_args_is_help=True, help="Programs that receive alarm events.")


@commands.command()
def secret() -> None:
    """Create a secret for signing events; the receiver needs the same one.

    [bold]Example[/bold]

    [cyan](umask 077; rotorwatch webhook secret > pager.secret)[/cyan]
    """
    from service.delivery.webhooks.signature import new_secret  # noqa: PLC0415  # keeps --help quick

    typer.echo(new_secret())


@commands.command()
def test(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the webhook in the settings.")],
    config: Annotated[Path, typer.Option("--config", metavar="FILE", help="Settings (TOML) of the monitor.")],
) -> None:
    """Send a test event, which is not an alarm, and report whether the receiver accepts it; exit code 1 if not.

    [bold]Example[/bold]

    [cyan]rotorwatch webhook test pager --config plant.toml[/cyan]
    """
    from service.delivery.webhooks.dispatcher import send_test  # noqa: PLC0415
    from service.settings.service import load_settings  # noqa: PLC0415  # keeps --help quick

    webhooks = load_settings(config).webhooks
    settings = next((webhook for webhook in webhooks if webhook.name == name), None)
    if settings is None:
        there = ", ".join(webhook.name for webhook in webhooks) or "none"
        raise MachineFileError(f"{config}: no webhook {name}; there are: {there}")
    took_s = send_test(settings)
    typer.echo(f"{name}: {settings.target} accepted the test event, in {took_s:.2f} s")
