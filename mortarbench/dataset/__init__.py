"""The public set: problems and sequences with proven optima, see docs/dataset.md."""

from mortarbench.dataset.folder import build as build
from mortarbench.dataset.folder import check as check
from mortarbench.dataset.folder import info as info
from mortarbench.dataset.leaderboard import leaderboard as leaderboard
