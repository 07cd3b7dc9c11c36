"""From photos or videos to the poses of their cameras, with pycolmap: call `place.place_photos`.

`folder` finds photos, `photos` reads and `conversion` converts them, `video` takes frames. `colmap` starts the process
in which `reconstruct` runs; `joining` joins cameras of its model that are one, `agreement` compares it with another
placing, and `judgement` says what speaks against it. `scene` keeps the state of the scene's folder, to which
`publishing` moves what was made.
"""
