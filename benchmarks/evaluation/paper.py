"""What the paper reports (arXiv:2206.08482, section 6, on up to eight A100s). Data only."""

from __future__ import annotations

from types import MappingProxyType

LGR = MappingProxyType(
    {
        "ant": {
            **{"2G2T": (107_689, 114_734), "2G3T": (138_369, 164_655)},
            "4G4T": (168_619, 207_834),
        },
        "humanoid": {
            **{"2G2T": (163_723, 168_300), "2G3T": (179_273, 190_919)},
            "4G4T": (308_873, 336_591),
        },
        "shadow_hand": {
            **{"2G2T": (78_270, 88_149), "2G3T": (79_545, 93_785)},
            "4G4T": (133_044, 166_722),
        },
    }
)
"""Environment steps per second with MPR and with LGR, by task and layout."""

CHANNELS = MappingProxyType(
    {
        ("anymal", 2): ((169_451, 180_001), (108_536, 122_676)),
        ("franka_cabinet", 2): ((98_819, 102_363), (40_778, 50_931)),
        ("anymal", 4): ((287_990, 312_366), (174_569, 215_876)),
        ("franka_cabinet", 4): ((171_015, 182_010), (67_027, 88_622)),
    }
)
"""PPS, then TTOP, with the uni-channel and with channels, by task and GPUs."""


def lgr_gain(task: str, layout: str) -> float:
    """LGR over MPR."""
    base, best = LGR[task][layout]
    return best / base
