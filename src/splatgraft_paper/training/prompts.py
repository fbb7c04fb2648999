"""Prompts of generated images: the paper's sentence (Sec. 5.3) with words from our own lists.

Objects are movable and of many materials. Environments name the surface below the object. Lightings name a direction
or hardness, which a harmoniser must recognise. Camera angles keep the floor in view.
"""

import random
from dataclasses import dataclass

TEMPLATE = (
    "A realistic photo of {article} {object} in {environment} with {lighting}, {angle}, full view of the {object}, "
    "foreground object clearly shown, resting naturally on a surface or floor, with visible contact shadow, "
    "everything in focus."
)

OBJECTS = (
    # furniture
    "wooden dining chair", "leather armchair", "velvet sofa", "rattan lounge chair", "steel bar stool",
    "upholstered footstool", "oak coffee table", "marble side table", "metal filing cabinet", "painted wooden cabinet",
    "wicker laundry basket", "folding step ladder", "child's rocking horse", "cast iron garden bench",
    # plants and vases
    "potted monstera plant", "bonsai tree in a clay pot", "cactus in a terracotta pot", "glazed ceramic vase",
    "glass vase with tulips", "bouquet of dried flowers in a jug",
    # kitchen
    "stainless steel kettle", "copper saucepan", "enamel teapot", "porcelain coffee cup on a saucer",
    "espresso machine", "toaster", "wooden bowl of oranges", "bunch of bananas", "loaf of bread on a board",
    "glass jar of honey", "wine bottle", "wooden pepper mill",
    # lamps, instruments, machines
    "brass table lamp", "paper floor lantern", "acoustic guitar", "violin", "brass trumpet", "snare drum",
    "vintage typewriter", "rotary telephone", "old film camera", "transistor radio", "mantel clock", "sewing machine",
    "standing electric fan", "globe on a wooden stand",
    # toys, sculpture, sport
    "teddy bear", "stack of wooden toy blocks", "red toy fire truck", "model steam locomotive", "plaster bust",
    "bronze statue of a horse", "stone garden gnome", "leather football", "bicycle helmet", "pair of hiking boots",
    "skateboard", "child's tricycle",
    # bags, tools, outdoors
    "brown leather suitcase", "canvas backpack", "straw hat", "wooden toolbox", "galvanised watering can",
    "metal bucket", "wheelbarrow", "motor scooter", "stack of old books", "cardboard box", "wooden barrel",
    "carved jack-o'-lantern",
)  # fmt: skip

ENVIRONMENTS = (
    "a bright living room with a parquet floor", "a kitchen with a stone worktop", "an office with a grey carpet",
    "a bedroom with a woollen rug", "a bathroom with white tiles", "a hallway with a chequered floor",
    "a library with dark wooden shelves", "a workshop with a worn wooden bench", "a garage with a concrete floor",
    "an attic with old floorboards", "a museum hall with polished granite", "a hotel lobby with a marble floor",
    "a café with a terrazzo floor", "a classroom with a linoleum floor", "an artist's studio with paint on the floor",
    "an empty loft with brick walls", "a greenhouse with a gravel floor", "a covered terrace with wooden decking",
    "a paved courtyard", "a garden with short grass", "a quiet street with cobblestones",
    "a train station with a tiled floor", "a church with a stone floor", "a cellar with brick vaults",
)  # fmt: skip

LIGHTINGS = (
    "low sunlight through a window on the left", "low sunlight through a window on the right",
    "hard midday sun from above", "soft overcast daylight", "warm evening light from behind",
    "cool morning light from a large window", "a single warm lamp on one side", "two lamps of different colours",
    "fluorescent ceiling lights", "a bright spotlight from above", "dim candlelight", "light through venetian blinds",
    "blue dusk light and a warm interior lamp", "diffuse light from a skylight",
)  # fmt: skip

ANGLES = (
    "eye-level view", "slightly elevated view", "high three-quarter view", "low-angle view", "view from the left side",
    "view from the right side", "wide shot from across the room", "close view from the front",
)  # fmt: skip


@dataclass(frozen=True)
class Prompt:
    """Words of one prompt."""

    object: str
    environment: str
    lighting: str
    angle: str

    @property
    def text(self) -> str:
        """Text of the prompt."""
        return TEMPLATE.format(article="an" if self.object[0] in "aeiou" else "a", **vars(self))


def prompt(seed: int, number: int) -> Prompt:
    """Make prompt `number`; objects follow a shuffled order, the other words are drawn at random."""
    rng = random.Random(f"prompt-{seed}-{number}")
    turn, place = divmod(number, len(OBJECTS))
    order = random.Random(f"objects-{seed}-{turn}").sample(OBJECTS, len(OBJECTS))
    return Prompt(order[place], rng.choice(ENVIRONMENTS), rng.choice(LIGHTINGS), rng.choice(ANGLES))
