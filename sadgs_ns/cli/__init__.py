"""The commands beside nerfstudio's: sadgs-process, sadgs-doctor, sadgs-inspect and sadgs-export."""
