"""The commands `train flux`, `compact`, `removal`, `embed`: one file each, joined here. Holds no work of its own."""

from typing import Annotated

import tyro

from splatgraft.commands.train.compact import TrainCompact
from splatgraft.commands.train.embed import TrainEmbed
from splatgraft.commands.train.flux import TrainFlux
from splatgraft.commands.train.removal import TrainRemoval

COMMAND = Annotated[
    Annotated[TrainFlux, tyro.conf.subcommand("flux")]
    | Annotated[TrainCompact, tyro.conf.subcommand("compact")]
    | Annotated[TrainRemoval, tyro.conf.subcommand("removal")]
    | Annotated[TrainEmbed, tyro.conf.subcommand("embed")],
    tyro.conf.OmitSubcommandPrefixes,
]
