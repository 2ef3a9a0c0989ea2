"""Pictures to a video: H.264 in MP4 by the encoder that Blender brings along."""

import errno
from collections.abc import Sequence
from pathlib import Path

from shinypartial.blender.runtime import import_blender, quiet
from shinypartial.io.files import atomic_write

#: Frames from one that is coded as a whole to the next.
GROUP = 12


def write_video(
    pictures: Sequence[Path], path: Path, size: tuple[int, int], frames_per_second: int, quality: str
) -> None:
    """Write pictures of one even size as frames of an MP4 without sound.

    `quality` is Blender's name for a rate factor. What is open in Blender is replaced. Raises InputError when Blender
    can't be loaded.
    """
    bpy = import_blender()
    with quiet(), atomic_write(path) as temporary:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        scene.render.resolution_x, scene.render.resolution_y = size
        scene.render.resolution_percentage, scene.render.dither_intensity = 100, 0
        scene.render.fps, scene.frame_start, scene.frame_end = frames_per_second, 1, len(pictures)
        scene.display_settings.display_device, scene.view_settings.view_transform = "sRGB", "Standard"
        scene.sequencer_colorspace_settings.name = "sRGB"  # Codes go through as they are.
        strips = scene.sequence_editor_create().strips
        strip = strips.new_image("film", str(pictures[0].resolve()), 1, 1)
        for picture in pictures[1:]:
            strip.elements.append(picture.name)
        strip.frame_final_duration = len(pictures)
        scene.render.use_sequencer, scene.render.use_compositing = True, False
        scene.render.image_settings.media_type = "VIDEO"
        scene.render.image_settings.file_format = "FFMPEG"
        video = scene.render.ffmpeg
        video.format, video.codec, video.audio_codec = "MPEG4", "H264", "NONE"
        video.constant_rate_factor, video.ffmpeg_preset, video.gopsize = quality, "GOOD", GROUP
        scene.render.use_file_extension = False
        scene.render.filepath = str(temporary.resolve())
        bpy.ops.render.render(animation=True)
        if not temporary.exists() or not temporary.stat().st_size:
            raise OSError(errno.EIO, "Blender wrote no video", str(path))
