"""Means over the latest episodes."""

from gmijax.metrics import Episodes, EpisodeWindow


def test_terms_and_metrics_are_means_over_episodes():
    window = EpisodeWindow()
    window.add(Episodes(1, 4.0, 10, {"alive": 2.0}, {"successes": 3.0}))
    window.add(Episodes(3, 8.0, 30, {"alive": 6.0}, {"successes": 5.0}))
    assert window.means() == {
        "return": 3.0,
        "episode_length": 10.0,
        "reward/alive": 2.0,
        "metric/successes": 2.0,
    }


def test_there_are_no_means_before_an_episode_has_ended():
    window = EpisodeWindow()
    window.add(Episodes(0, 0.0, 0, {"alive": 0.0}, {}))
    assert window.means() == {"return": None, "episode_length": None}
