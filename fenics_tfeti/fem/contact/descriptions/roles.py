"""Which surface of a contact is the slave: as the user gave it, and as it is used."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fenics_tfeti.errors import warn_user
from fenics_tfeti.fem.contact.descriptions.contacts import Contact, ContactPair
from fenics_tfeti.fem.contact.descriptions.laws import RoughContact

# Ratio of E / h from which on an exchange is worth it: it is about that of the two condition
# numbers, so that bounds of the iterations differ by a factor of two.
EXCHANGE_RATIO = 4.0


_FACT = "E / h of the given slave is {:.2g} times that of the master"


@dataclass(frozen=True)
class Roles:
    """The slave and the master of a contact as they are used."""

    given: Contact  # as the user gave it
    used: Contact  # the same object, or the pair with slave and master exchanged
    ratio: float | None = None  # E / h of the slave over that of the master, as they are used
    reason: str | None = None  # for the report; None where the given roles are good ones
    are_decided: bool = False  # from the stiffness of the bodies

    @property
    def may_exchange(self) -> bool:
        """Whether slave and master may be exchanged."""
        pair = self.given
        return isinstance(pair, ContactPair) and pair.roles == "auto" and not _one_sided_data(pair)

    @property
    def _are_poor(self) -> bool:
        return self.ratio is not None and self.ratio > EXCHANGE_RATIO

    @property
    def are_better_exchanged(self) -> bool:
        """Whether the given roles should be exchanged, and may be."""
        return self._are_poor and self.may_exchange

    def exchanged(self) -> Roles:
        """Return exchanged roles: because of the ratio, or without one of a rigid slave."""
        pair, why, ratio = self.given, "the given slave is rigid", None
        assert isinstance(pair, ContactPair)
        if self.ratio is not None:
            why, ratio = _FACT.format(self.ratio), 1.0 / self.ratio
        used = replace(pair, slave=pair.master, master=pair.slave)
        reason = f"slave and master are exchanged: {why}"
        return replace(self, used=used, ratio=ratio, reason=reason)

    def kept(self, obstacle: str = "") -> Roles:
        """Return the given roles as decided, with the error that exchanged ones raise, if any."""
        pair, reason = self.given, None
        assert isinstance(pair, ContactPair)
        if self._are_poor:
            data, why = _one_sided_data(pair), f"the other way round {obstacle}"
            if pair.roles == "given":
                why = "roles='given'"
            elif data:
                why = f"'{data}' belongs to the given slave"
            fact = _FACT.format(self.ratio)
            reason = f"slave and master are as given, though {fact}: {why}"
        return replace(self, used=pair, reason=reason, are_decided=True)

    def warn(self, name: str) -> None:
        """Warn if the slave is much the stiffer or finer surface."""
        largest_condition = 20.0
        ratio = self.ratio or 0.0
        if 1.0 + ratio > largest_condition:
            warn_user(
                f"{name}: the slave should be the softer surface, or of two equally stiff ones "
                f"that with the larger facets. E / h of this one is {ratio:.0f} times that of the "
                "master, which may cost iterations. Exchange slave and master; roles='auto' does "
                "it, unless data of the contact belong to the given slave"
            )


def _one_sided_data(contact: ContactPair) -> str:
    """Return the argument of a pair, if any, whose values belong to the slave that was given."""
    laws = [law for law in (contact.friction, contact.law) if law is not None]
    varying = [
        law
        for law in laws
        if not isinstance(law, RoughContact)
        if not all(value is None or np.isscalar(value) for value in vars(law).values())
    ]
    one_sided = {
        "normal": contact.normal is not None,
        "initial_gap": callable(contact.initial_gap),
        "friction": contact.friction in varying,
        "law": contact.law in varying,
    }
    return next((name for name, present in one_sided.items() if present), "")
