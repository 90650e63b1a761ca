"""Groups of verbs: the one place where an error becomes an exit status and a sentence."""

from typing import Any

import typer
from typer.core import TyperGroup

from sl3d_slam.errors import Sl3dError

WRONG_INPUT = 2
INTERRUPTED = 130


def make_verbs(**options: Any) -> typer.Typer:
    """Return an application of verbs, with plain help: rich would double the time it takes."""
    return typer.Typer(
        cls=Verbs,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        **options,
    )


class Verbs(TyperGroup):
    """The group of all verbs.

    An :class:`Sl3dError` is the user's to act on: one sentence, status 2. Ctrl-C is status 130.
    Wrong usage is status 2 by typer itself. Anything else is a bug and keeps its traceback.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen verb."""
        try:
            return super().invoke(ctx)
        except Sl3dError as error:
            typer.echo(f"sl3d: {error}", err=True)
            raise typer.Exit(WRONG_INPUT) from None
        except KeyboardInterrupt:
            typer.echo("\nsl3d: interrupted", err=True)
            raise typer.Exit(INTERRUPTED) from None
