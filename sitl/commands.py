"""The commands of this package, as `vrspray` lists them; nothing else is imported for that."""

from companion.commands import Command

DEMO = Command(
    target="sitl.demo_cli:demo",
    help="Simulate the field of Wang et al. 2024 with all methods; compare.",
    haste="patient",
)
CAMPAIGN = Command(
    target="sitl.campaign.cli:app",
    help="Simulate many flights, varying settings; show the results.",
    haste="patient",
    hastes={"show": "quick"},
)
SITL = Command(
    target="sitl.cli:app",
    help="Simulate a flight controller and sprayer.",
    hastes={"fly": "patient"},
)
EXAMPLES = Command(
    target="sitl.examples_cli:app",
    help="List the examples, or copy one into a folder of yours.",
    haste="quick",
)
