"""Motions of fingers that hold nothing: to an opening, and until they touch a part.

`empty_motion` moves empty fingers, `mechanics_proof` proves that they move as the settings say,
`approach` closes them until the pads show a contact.
"""
