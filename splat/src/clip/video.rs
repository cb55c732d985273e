//! Videos to numbered PNG frames, by an `ffmpeg` on the PATH.

use std::{
    ffi::OsString,
    fs, io,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use super::{ClipError, digest, frame_files::stem_of};

/// Decodes videos into subfolders of a scratch folder; what is there already is kept.
#[derive(Clone, Debug)]
pub(super) struct Decoder<'a> {
    /// Program to run.
    pub(super) program: &'a str,
    /// Folder that holds one subfolder of frames per video.
    pub(super) scratch: &'a Path,
    /// First and last frame to decode, counted from 1; all if `None`.
    pub(super) frames: Option<(u32, u32)>,
}

impl Decoder<'_> {
    /// Folder with `frame_00001.png` and on, one per frame of the video.
    ///
    /// Its name holds the digest of the video and the frames asked for, so a changed video is decoded again; it
    /// appears under that name only once complete, so an interrupted decoding leaves nothing half done behind.
    pub(super) fn decode(&self, video: &Path) -> Result<PathBuf, ClipError> {
        let folder = self.scratch.join(self.folder_name(video)?);
        if folder.is_dir() {
            return Ok(folder);
        }
        let partial = folder.with_extension("partial");
        if partial.exists() {
            fs::remove_dir_all(&partial).map_err(ClipError::io(&partial))?;
        }
        fs::create_dir_all(&partial).map_err(ClipError::io(&partial))?;
        let decoded = self.run(video, &partial);
        if decoded.is_err() {
            // The error that matters is the decoder's; leftovers are removed on the next attempt too.
            fs::remove_dir_all(&partial).ok();
        }
        decoded?;
        fs::rename(&partial, &folder).map_err(ClipError::io(&folder))?;
        Ok(folder)
    }

    fn folder_name(&self, video: &Path) -> Result<String, ClipError> {
        let digest = digest::file(video)?.to_hex();
        let frames = self.frames.map_or_else(|| "all".to_owned(), |(first, last)| format!("{first}-{last}"));
        Ok(format!("{}-{}-{frames}", stem_of(video), &digest[..16]))
    }

    fn run(&self, video: &Path, folder: &Path) -> Result<(), ClipError> {
        let video_path = fs::canonicalize(video).map_err(ClipError::io(video))?;
        let output = Command::new(self.program)
            .args(arguments(&video_path, self.frames))
            // A relative output pattern keeps `%` in the scratch path from being read as one.
            .current_dir(folder)
            .stdin(Stdio::null())
            .output();
        let output = match output {
            Ok(output) => output,
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                return Err(ClipError::NoFfmpeg {
                    video: video.to_owned(),
                    program: self.program.to_owned(),
                });
            }
            Err(error) => return Err(ClipError::io(self.program)(error)),
        };
        if !output.status.success() {
            let message = String::from_utf8_lossy(&output.stderr).trim().replace('\n', "; ");
            return Err(ClipError::Ffmpeg { video: video.to_owned(), message });
        }
        Ok(())
    }
}

/// One PNG per coded frame, none dropped or doubled to keep a frame rate: each gets the time of its number at a
/// fixed rate, whatever the video's own time stamps are.
fn arguments(video: &Path, frames: Option<(u32, u32)>) -> Vec<OsString> {
    let select = frames.map_or_else(String::new, |(first, last)| {
        format!("select='between(n,{},{})',", i64::from(first) - 1, i64::from(last) - 1)
    });
    let filter = format!("{select}settb=1/25,setpts=N");
    let start = frames.map_or(1, |(first, _)| first.max(1)).to_string();
    let mut input = OsString::from("file:");
    input.push(video);
    let mut arguments: Vec<OsString> =
        ["-nostdin", "-hide_banner", "-loglevel", "error", "-i"].map(OsString::from).into();
    arguments.push(input);
    let output = [
        "-map",
        "0:v:0",
        "-vf",
        &filter,
        "-r",
        "25",
        "-pix_fmt",
        "rgb24",
        "-start_number",
        &start,
        "frame_%05d.png",
    ];
    arguments.extend(output.map(OsString::from));
    arguments
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::clip::{frame_files::numbered_images, testing::skip};

    #[test]
    fn a_missing_ffmpeg_is_explained() {
        let folder = tempfile::tempdir().expect("a folder");
        let video = folder.path().join("cam00.mp4");
        fs::write(&video, b"not decoded anyway").expect("a file");
        let scratch = folder.path().join("scratch");
        let decoder = Decoder { program: "ffmpeg-that-is-not-installed", scratch: &scratch, frames: None };
        let error = decoder.decode(&video).expect_err("no such program");
        assert!(matches!(error, ClipError::NoFfmpeg { .. }));
        let message = error.to_string();
        for part in ["cam00.mp4", "ffmpeg-that-is-not-installed", "apt install ffmpeg", "PATH"] {
            assert!(message.contains(part), "{message}");
        }
        assert_eq!(fs::read_dir(&scratch).expect("listed").count(), 0, "nothing half done stays");
    }

    #[test]
    fn arguments_name_the_frames() {
        let joined = |frames| {
            let words = arguments(Path::new("/a b/cam00.mp4"), frames);
            words.iter().map(|word| word.to_string_lossy().into_owned()).collect::<Vec<_>>().join(" ")
        };
        assert!(joined(None).contains("-i file:/a b/cam00.mp4 -map 0:v:0 -vf settb=1/25,setpts=N -r 25"));
        assert!(joined(None).contains("-start_number 1 frame_%05d.png"));
        let some = joined(Some((3, 7)));
        assert!(
            some.contains("-vf select='between(n,2,6)',settb=1/25,setpts=N")
                && some.contains("-start_number 3")
        );
    }

    /// Whether this machine has an ffmpeg that runs; tests that need one say so and stop otherwise.
    pub(in crate::clip) fn has_ffmpeg() -> bool {
        Command::new("ffmpeg").arg("-version").output().is_ok_and(|output| output.status.success())
    }

    /// A 64x48 video whose frame `n` (from 1) is grey of about `20 n`.
    pub(in crate::clip) fn write_video(path: &Path, frames: u32) {
        let source = format!(
            "color=c=black:s=64x48:r=30,geq=lum='16+20*(N+1)*219/255':cb=128:cr=128,trim=end_frame={frames}"
        );
        let made = Command::new("ffmpeg")
            .args([
                "-nostdin",
                "-loglevel",
                "error",
                "-f",
                "lavfi",
                "-i",
                &source,
                "-c:v",
                "mpeg4",
                "-q:v",
                "1",
            ])
            .arg(path)
            .output()
            .expect("ffmpeg runs");
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    }

    #[test]
    fn frames_are_neither_dropped_nor_doubled() {
        if !has_ffmpeg() {
            skip("no ffmpeg on the PATH");
            return;
        }
        let folder = tempfile::tempdir().expect("a folder");
        // A per cent sign must not be taken for the number of a frame.
        let scratch = folder.path().join("100%05d");
        let video = folder.path().join("cam:00.mp4");
        write_video(&video, 9);
        for (frames, expected) in [(None, 1..=9), (Some((3, 5)), 3..=5), (Some((8, 20)), 8..=9)] {
            let decoder = Decoder { program: "ffmpeg", scratch: &scratch, frames };
            let decoded = decoder.decode(&video).expect("decoded");
            let images = numbered_images(&decoded).expect("frames");
            assert_eq!(images.keys().copied().collect::<Vec<_>>(), expected.collect::<Vec<_>>());
            for (number, path) in images {
                let image = crate::image::Image::decode(&fs::read(path).expect("read")).expect("decoded");
                let grey = image.at(32, 24)[1] * 255.0;
                // The codec is lossy: half of the difference between frames is what tells them apart.
                assert!((grey - 20.0 * number as f32).abs() < 10.0, "frame {number} is {grey}");
            }
            let stamp = fs::metadata(&decoded).and_then(|data| data.modified()).expect("a time");
            assert_eq!(decoder.decode(&video).expect("kept"), decoded);
            assert_eq!(fs::metadata(&decoded).and_then(|data| data.modified()).expect("a time"), stamp);
        }
        let broken = folder.path().join("broken.mp4");
        fs::write(&broken, b"no video").expect("a file");
        let error = Decoder { program: "ffmpeg", scratch: &scratch, frames: None }
            .decode(&broken)
            .expect_err("no video");
        assert!(matches!(&error, ClipError::Ffmpeg { video, .. } if *video == broken), "{error}");
    }
}
