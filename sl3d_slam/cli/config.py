"""``sl3d config``: the settings a run would use."""

import typer

from sl3d_slam.cli.options import ConfigOption, SetOption


def config(config: ConfigOption = None, overrides: SetOption = None) -> None:
    """Print every setting as a run would use it, as YAML that --config reads back."""
    from sl3d_slam.config import dump_config, load_config

    typer.echo(dump_config(load_config(config, overrides or ())), nl=False)
