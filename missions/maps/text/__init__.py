"""P2's open text map and its grid."""
