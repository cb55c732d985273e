//! Decoded images under a byte budget, least recently used first out.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use crate::image::{Image, Mask};

/// View and frame index.
pub(super) type Key = (usize, usize);

/// What is cached.
#[derive(Clone, Debug)]
enum Entry {
    Image(Arc<Image>),
    Mask(Arc<Mask>),
}

/// Images and masks of a clip, shared between threads.
#[derive(Debug)]
pub(super) struct Cache {
    budget: u64,
    held: Mutex<Held>,
}

#[derive(Debug, Default)]
struct Held {
    entries: HashMap<(Key, Kind), Slot>,
    bytes: u64,
    clock: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Kind {
    Image,
    Mask,
}

#[derive(Debug)]
struct Slot {
    entry: Entry,
    bytes: u64,
    used: u64,
}

impl Cache {
    pub(super) fn new(budget: u64) -> Self {
        Self { budget, held: Mutex::default() }
    }

    pub(super) fn image(&self, key: Key) -> Option<Arc<Image>> {
        match self.get((key, Kind::Image))? {
            Entry::Image(image) => Some(image),
            Entry::Mask(_) => None,
        }
    }

    pub(super) fn mask(&self, key: Key) -> Option<Arc<Mask>> {
        match self.get((key, Kind::Mask))? {
            Entry::Mask(mask) => Some(mask),
            Entry::Image(_) => None,
        }
    }

    pub(super) fn keep_image(&self, key: Key, image: &Arc<Image>) {
        let bytes = size_of_val(image.pixels.as_slice()) as u64;
        self.put((key, Kind::Image), Entry::Image(image.clone()), bytes);
    }

    pub(super) fn keep_mask(&self, key: Key, mask: &Arc<Mask>) {
        let bytes = size_of_val(mask.inside.as_slice()) as u64;
        self.put((key, Kind::Mask), Entry::Mask(mask.clone()), bytes);
    }

    fn lock(&self) -> MutexGuard<'_, Held> {
        // Every change below leaves the map valid, so a panic elsewhere cannot have broken it.
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn get(&self, key: (Key, Kind)) -> Option<Entry> {
        let mut held = self.lock();
        held.clock += 1;
        let now = held.clock;
        let slot = held.entries.get_mut(&key)?;
        slot.used = now;
        Some(slot.entry.clone())
    }

    fn put(&self, key: (Key, Kind), entry: Entry, bytes: u64) {
        if bytes > self.budget {
            return;
        }
        let mut held = self.lock();
        held.clock += 1;
        let slot = Slot { entry, bytes, used: held.clock };
        // Two threads may have decoded the same image.
        let replaced = held.entries.insert(key, slot).map_or(0, |old| old.bytes);
        held.bytes = held.bytes - replaced + bytes;
        while held.bytes > self.budget {
            let Some(oldest) = held.entries.iter().min_by_key(|(_, slot)| slot.used).map(|(key, _)| *key)
            else {
                return;
            };
            held.bytes -= held.entries.remove(&oldest).map_or(0, |slot| slot.bytes);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(value: f32) -> Arc<Image> {
        Arc::new(Image::filled(10, 10, [value; 3]))
    }

    const IMAGE_BYTES: u64 = 10 * 10 * 3 * 4;

    #[test]
    fn the_least_recently_used_goes_first() {
        let cache = Cache::new(2 * IMAGE_BYTES);
        cache.keep_image((0, 0), &image(0.0));
        cache.keep_image((0, 1), &image(0.1));
        assert!(cache.image((0, 0)).is_some());
        cache.keep_image((0, 2), &image(0.2));
        assert!(cache.image((0, 1)).is_none());
        assert_eq!(cache.image((0, 0)).expect("kept").at(0, 0), [0.0; 3]);
        assert_eq!(cache.image((0, 2)).expect("kept").at(0, 0), [0.2; 3]);
        assert_eq!(cache.lock().bytes, 2 * IMAGE_BYTES);
    }

    #[test]
    fn the_budget_holds() {
        let cache = Cache::new(3 * IMAGE_BYTES + 1);
        for frame in 0..50 {
            cache.keep_image((frame % 3, frame), &image(0.5));
            let held = cache.lock();
            assert!(held.bytes <= 3 * IMAGE_BYTES + 1);
            assert_eq!(held.bytes, held.entries.len() as u64 * IMAGE_BYTES);
        }
        let none = Cache::new(IMAGE_BYTES - 1);
        none.keep_image((0, 0), &image(0.5));
        assert!(none.image((0, 0)).is_none());
    }

    #[test]
    fn a_key_counts_once_and_masks_are_apart() {
        let cache = Cache::new(10 * IMAGE_BYTES);
        cache.keep_image((1, 1), &image(0.1));
        cache.keep_image((1, 1), &image(0.2));
        assert!(cache.mask((1, 1)).is_none());
        let mask = Arc::new(Mask { width: 10, height: 10, inside: vec![true; 100] });
        cache.keep_mask((1, 1), &mask);
        assert_eq!(cache.mask((1, 1)), Some(mask));
        assert_eq!(cache.lock().bytes, IMAGE_BYTES + 100);
        assert_eq!(cache.image((1, 1)).expect("kept").at(0, 0), [0.2; 3]);
    }
}
