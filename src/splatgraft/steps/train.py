"""The commands `train flux`, `compact`, `removal`, `embed`: one file each, joined here. Holds no work of its own."""

from typing import Annotated

import tyro

from splatgraft.steps.train_compact import TrainCompact
from splatgraft.steps.train_embed import TrainEmbed
from splatgraft.steps.train_flux import TrainFlux
from splatgraft.steps.train_removal import TrainRemoval

COMMAND = Annotated[
    Annotated[TrainFlux, tyro.conf.subcommand("flux")]
    | Annotated[TrainCompact, tyro.conf.subcommand("compact")]
    | Annotated[TrainRemoval, tyro.conf.subcommand("removal")]
    | Annotated[TrainEmbed, tyro.conf.subcommand("embed")],
    tyro.conf.OmitSubcommandPrefixes,
]
