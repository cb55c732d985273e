//! Fields that are made from a file's arrays one at a time.

use std::fmt;

use crate::tracking::TrackField;

/// The tracks of one view as a file gives them; index `i` is the field of frame `i + 2`, counting the key frame as 1.
///
/// Holds the arrays of the file. A field has the size of the images whatever the file holds per frame, so all fields
/// may need far more memory than the file: take those that are wanted, one at a time.
pub struct ImportedTracks {
    count: usize,
    size: (u32, u32),
    field: Box<dyn Fn(usize) -> TrackField + Send + Sync>,
}

impl ImportedTracks {
    /// `field` is called for indices below `count` only, and gives fields of `size`.
    pub(super) fn new(
        count: usize,
        size: (u32, u32),
        field: impl Fn(usize) -> TrackField + Send + Sync + 'static,
    ) -> Self {
        Self { count, size, field: Box::new(field) }
    }

    /// Number of fields.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Width and height of every field.
    pub fn size(&self) -> (u32, u32) {
        self.size
    }

    /// Makes one field; none beyond the last.
    pub fn field(&self, index: usize) -> Option<TrackField> {
        (index < self.count).then(|| (self.field)(index))
    }

    /// Makes every field, in order.
    pub fn fields(&self) -> impl Iterator<Item = TrackField> {
        (0..self.count).map(&self.field)
    }
}

impl fmt::Debug for ImportedTracks {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_struct("ImportedTracks")
            .field("count", &self.count)
            .field("size", &self.size)
            .finish_non_exhaustive()
    }
}
