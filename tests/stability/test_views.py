"""What no photo shows: colours from other directions, needles."""

from clsplat.bench.stability.views import ERANK_PENALTY, needles, unseen_colors


def test_unseen_sides_keep_their_colour(device):
    """Bands that four photos do not constrain take any colour on the other side."""
    assert unseen_colors(3, device)[0] > 1.5 * unseen_colors(1, device)[0]


def test_the_regulariser_leaves_fewer_needles(device):
    """Effective rank, Hyung et al. 2024."""
    plain, regular = (needles(p, device)[0] for p in (0.0, ERANK_PENALTY))
    assert plain > 2 * regular
