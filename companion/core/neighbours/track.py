"""Tracks: what one vehicle can have said, sample after sample; a peer has more than one while its place is in doubt."""

from dataclasses import dataclass, field

from companion.core.frames import Ned
from companion.core.values import PeerSample


@dataclass(slots=True)
class Track:
    """What one vehicle can have said, sample after sample."""

    sample: PeerSample
    reference_then: tuple[Ned, Ned]
    """p_ref and v_d of its slot at the sample's time"""
    first_ns: int
    """time of its first sample"""
    own: tuple[PeerSample, tuple[Ned, Ned]] | None
    """the last sample that the peer sent itself, with its reference"""
    reached: bool = True
    """it can have flown here from what was told before"""
    same_since_ns: int = 0
    """time of the first sample with its present position"""
    due_ns: int = 0
    """fleet time from which it is lost if nothing more is heard"""
    due_stopped_ns: int = 0
    """what `stopped_ns` is then"""
    due_flown_ns: int = 0
    lost_at_ns: int | None = None
    """fleet time at which presence ended or silence became too long"""
    silent: bool = False
    """it is lost by its silence, not by the end of its presence"""
    stopped_ns: int = 0
    """of a lost one: it flew on until then at least"""
    flown_ns: int = 0
    """and no longer than until then"""
    path: list[Ned] = field(default_factory=list)
    """where it may be, every PATH_STEP_NS from `stopped_ns` on"""

    @property
    def lost(self) -> bool:
        """Whether its presence has ended, or its silence was too long."""
        return self.lost_at_ns is not None

    def fall_silent(self) -> None:
        """It has said nothing for too long."""
        self.lose(self.due_ns, self.due_stopped_ns, self.due_flown_ns, silent=True)

    def lose(self, at_ns: int, stopped_ns: int, flown_ns: int, silent: bool) -> None:
        """It is lost; where it may be begins at `stopped_ns`."""
        self.lost_at_ns, self.silent = at_ns, silent
        self.stopped_ns, self.flown_ns = max(stopped_ns, self.sample.time_ns), flown_ns
        self.path = []

    def take(self, sample: PeerSample, reference_then: tuple[Ned, Ned]) -> None:
        """Its next sample."""
        if sample.position_ned_m != self.sample.position_ned_m:
            self.same_since_ns = sample.time_ns
        self.sample, self.reference_then, self.path = sample, reference_then, []
        self.stopped_ns = max(self.stopped_ns, sample.time_ns)


@dataclass(slots=True)
class Peer:
    """What is known of one peer."""

    tracks: list[Track] = field(default_factory=list)
    """the one that was told of last in front; more than one while it is not known where the vehicle is"""
    boots: dict[int, tuple[int, int]] = field(default_factory=dict)
    """boot id -> times of its first sample and of its last"""
    boot_id: int | None = None
    present: bool = False
    suspect_until_ns: int = 0
    """fleet time until which nothing is built on what it says"""
    twofold_until_ns: int = 0
    """the same, since two sources speak under its id"""
    noted_until_ns: int = 0
    """until then another place of it is not noted again: a liar writes no log"""
    due_soon: bool = False
    """its last message came in near mode, so that one that is missing is known to be"""
