"""Proof of a controller file's maker: detached signatures in the format of OpenSSF Model Signing.

A signature is a sigstore bundle (``bundle``) with a DSSE envelope of an in-toto statement (``statement``), which
lists the SHA-256 of the controller's file and of its manifest's JSON file. The package ``model-signing`` verifies
it too. Only ``keys`` imports the package cryptography, so the runtime does without it until a signature is asked for.
"""
