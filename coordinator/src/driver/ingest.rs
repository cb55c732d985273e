//! Ingest: every image and mask is decoded once, checked against its camera, and copied into the store.

use std::{collections::BTreeSet, sync::Arc};

use bytes::Bytes;
use rayon::prelude::*;
use splat::clip::{Clip, Split, View};

use super::{Job, progress::StageProgress};
use crate::{
    compute::go_on,
    failure::StageError,
    store::{ImageRecord, ViewRecord},
};

/// Encoded bytes of one view at one frame.
struct ViewFiles {
    image: Bytes,
    mask: Option<Bytes>,
}

impl Job {
    pub(super) async fn ingest(&mut self) -> Result<(), StageError> {
        let clip = self.clip().await?;
        check_views(clip.views(), &self.record.clip)?;
        let views: Vec<ViewRecord> = clip.views().iter().map(view_record).collect();
        let mut change = self.hub.store.change().await?;
        change.set_views(&self.id, &views).await?;
        change.commit().await?;

        let progress = StageProgress::new(self, "ingest");
        let total = self.frames.len() as u64;
        let _turn = self.turn().await?;
        for (index, &frame) in self.frames.iter().enumerate() {
            go_on(&self.stop)?;
            if !self.is_ingested(frame, views.len()).await? {
                self.ingest_frame(&clip, index, frame).await?;
            }
            let _ = progress.advance(total);
        }
        Ok(())
    }

    async fn is_ingested(&self, frame: u32, views: usize) -> Result<bool, StageError> {
        let images = self.hub.store.images(&self.id, frame).await?;
        if images.len() != views {
            return Ok(false);
        }
        for ImageRecord { image, mask, .. } in &images {
            if !self.hub.blobs.holds(image).await {
                return Ok(false);
            }
            if let Some(mask) = mask
                && !self.hub.blobs.holds(mask).await
            {
                return Ok(false);
            }
        }
        Ok(true)
    }

    async fn ingest_frame(&self, clip: &Arc<Clip>, index: usize, frame: u32) -> Result<(), StageError> {
        let clip = clip.clone();
        let read = move || -> Result<Vec<ViewFiles>, StageError> {
            (0..clip.views().len()).into_par_iter().map(|view| read_view(&clip, view, index)).collect()
        };
        let mut records = Vec::new();
        for (position, files) in self.hub.compute.run(read).await?.into_iter().enumerate() {
            let image = self.hub.blobs.put(files.image).await?;
            let mask = match files.mask {
                Some(mask) => Some(self.hub.blobs.put(mask).await?),
                None => None,
            };
            records.push(ImageRecord { position, image, mask });
        }
        let mut change = self.hub.store.change().await?;
        change.set_images(&self.id, frame, &records).await?;
        Ok(change.commit().await?)
    }
}

fn view_record(view: &View) -> ViewRecord {
    ViewRecord { name: view.name.clone(), held_out: view.split == Split::Test, camera: view.camera.clone() }
}

fn check_views(views: &[View], clip: &str) -> Result<(), StageError> {
    let training = views.iter().filter(|view| view.split == Split::Train).count();
    if training < 2 {
        return Err(StageError::bad_input(format!(
            "the clip {clip} has {training} training views of {}; a reconstruction needs at least 2: hold out fewer test \
             views or add cameras",
            views.len()
        )));
    }
    let mut names = BTreeSet::new();
    match views.iter().find(|view| !names.insert(view.name.as_str())) {
        Some(twin) => Err(StageError::bad_input(format!(
            "the clip {clip} has two views named '{}'; give every camera its own name",
            twin.name
        ))),
        None => Ok(()),
    }
}

/// Reads one view's files. The clip decodes them and checks their sizes, so that a damaged one fails the job before any
/// frame is computed.
fn read_view(clip: &Clip, view: usize, index: usize) -> Result<ViewFiles, StageError> {
    let bad = |error: splat::clip::ClipError| StageError::bad_input(error.to_string());
    let image = clip.encoded_image(view, index).map_err(bad)?;
    let mask = clip.encoded_mask(view, index).map_err(bad)?;
    Ok(ViewFiles { image: image.into(), mask: mask.map(Bytes::from) })
}
