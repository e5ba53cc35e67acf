"""The rotor of Mendes et al., as the tests of rotors have it."""

from tests.methods.rotor.conftest import mendes_rotor as mendes_rotor
