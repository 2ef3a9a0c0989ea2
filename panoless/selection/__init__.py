"""Which kind of geometry a scene needs: candidates, their evidence and the verdict. Imports geometry and below."""
