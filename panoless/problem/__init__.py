"""What every fit is made of: rays, blocks of unknowns and the evidence for them. Imports capture and below."""
