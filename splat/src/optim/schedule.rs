//! Which view comes next, and when to stop.

use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

/// Every view once per epoch, in a new random order each time.
#[derive(Clone, Debug)]
pub struct Epochs {
    views: usize,
    order: Vec<usize>,
}

impl Epochs {
    /// `views` of them; at least one.
    pub fn new(views: usize) -> Self {
        Self { views: views.max(1), order: Vec::new() }
    }

    /// The next view.
    pub fn next(&mut self, random: &mut ChaCha8Rng) -> usize {
        if self.order.is_empty() {
            self.order.extend(0..self.views);
            self.order.shuffle(random);
        }
        self.order.pop().unwrap_or(0)
    }
}

/// Says when the mean loss of a window is hardly below that of the window before.
#[derive(Clone, Debug)]
pub struct Plateau {
    window: u32,
    improvement: f32,
    seen: u32,
    sum: f64,
    previous: f64,
}

impl Plateau {
    /// At least `window` steps per window, in whole epochs of `views`, as views differ in their loss; 0 never reaches a plateau.
    pub fn new(window: u32, improvement: f32, views: usize) -> Self {
        let window = window.next_multiple_of(u32::try_from(views.max(1)).unwrap_or(1));
        Self { window, improvement, seen: 0, sum: 0.0, previous: f64::INFINITY }
    }

    /// Whether a window closes with the loss of step number `steps`: others need not be taken yet.
    pub fn is_due(&self, steps: u32) -> bool {
        self.window > 0 && steps.is_multiple_of(self.window)
    }

    /// Takes the loss of one step.
    pub fn is_reached(&mut self, loss: f32) -> bool {
        if self.window == 0 {
            return false;
        }
        self.seen += 1;
        self.sum += f64::from(loss);
        if self.seen < self.window {
            return false;
        }
        let mean = self.sum / f64::from(self.window);
        let flat = mean > self.previous * (1.0 - f64::from(self.improvement));
        (self.seen, self.sum, self.previous) = (0, 0.0, mean);
        flat
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn an_epoch_shows_every_view_once() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut epochs = Epochs::new(5);
        for _ in 0..3 {
            let mut seen: Vec<usize> = (0..5).map(|_| epochs.next(&mut random)).collect();
            seen.sort_unstable();
            assert_eq!(seen, [0, 1, 2, 3, 4]);
        }
    }

    #[test]
    fn a_falling_loss_is_no_plateau_and_a_flat_one_is() {
        let mut plateau = Plateau::new(10, 0.01, 5);
        assert!(!(0..50).any(|step| plateau.is_reached(1.0 / (1.0 + step as f32))));
        let mut plateau = Plateau::new(10, 0.01, 5);
        let stop = (0..50).position(|_| plateau.is_reached(0.5));
        assert_eq!(stop, Some(19), "at the end of the second window");
    }

    #[test]
    fn no_window_means_no_plateau() {
        let mut plateau = Plateau::new(0, 1.0, 3);
        assert!(!(0..100).any(|_| plateau.is_reached(0.5)));
    }
}
