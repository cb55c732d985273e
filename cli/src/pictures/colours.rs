//! Colours of directions and of magnitudes.

use std::f32::consts::TAU;

/// Corners of the wheel and the steps to the next: hues spread as evenly as the eye sees them (Baker et al., "A
/// Database and Evaluation Methodology for Optical Flow", 2011).
const CORNERS: [([f32; 3], f32); 6] = [
    ([1.0, 0.0, 0.0], 15.0),
    ([1.0, 1.0, 0.0], 6.0),
    ([0.0, 1.0, 0.0], 4.0),
    ([0.0, 1.0, 1.0], 11.0),
    ([0.0, 0.0, 1.0], 13.0),
    ([1.0, 0.0, 1.0], 6.0),
];
const STEPS: f32 = 55.0;

/// Dark to bright.
const HEAT: [[f32; 3]; 5] =
    [[0.03, 0.02, 0.15], [0.35, 0.05, 0.45], [0.80, 0.20, 0.30], [0.98, 0.60, 0.15], [1.0, 1.0, 0.75]];

/// Colour of a displacement, of which length 1 is fully saturated: right is red, down yellow, left cyan, up blue to
/// violet; white at rest. Longer ones are darker.
pub(super) fn wheel([u, v]: [f32; 2]) -> [f32; 3] {
    let length = u.hypot(v);
    if !length.is_finite() {
        return [0.0; 3];
    }
    let pure = hue(v.atan2(u).rem_euclid(TAU) / TAU);
    if length > 1.0 {
        return pure.map(|value| 0.75 * value);
    }
    pure.map(|value| 1.0 - length * (1.0 - value))
}

/// The wheel's colour at a fraction of a turn from the first corner.
fn hue(turn: f32) -> [f32; 3] {
    let mut step = turn * STEPS;
    for (i, (from, steps)) in CORNERS.iter().enumerate() {
        if step < *steps {
            return mixed(*from, CORNERS[(i + 1) % CORNERS.len()].0, step / steps);
        }
        step -= steps;
    }
    CORNERS[0].0
}

/// Colour of a level from 0 to 1; beyond, that of the end.
pub(super) fn heat(level: f32) -> [f32; 3] {
    // `clamp` leaves NaN, which converts to 0.
    let place = level.clamp(0.0, 1.0) * (HEAT.len() - 1) as f32;
    let low = (place as usize).min(HEAT.len() - 2);
    let fraction = place - low as f32;
    mixed(HEAT[low], HEAT[low + 1], if fraction.is_finite() { fraction } else { 1.0 })
}

pub(super) fn mixed(a: [f32; 3], b: [f32; 3], share: f32) -> [f32; 3] {
    std::array::from_fn(|channel| a[channel] + share * (b[channel] - a[channel]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(a: [f32; 3], b: [f32; 3]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-4)
    }

    #[test]
    fn directions_have_the_colours_of_the_wheel() {
        assert!(near(wheel([1.0, 0.0]), [1.0, 0.0, 0.0]));
        // A quarter of 55 steps lies 13.75 of 15 between red and yellow; half of them 2.5 of 11 after cyan.
        assert!(near(wheel([0.0, 1.0]), [1.0, 13.75 / 15.0, 0.0]));
        assert!(near(wheel([-1.0, 0.0]), [0.0, 1.0 - 2.5 / 11.0, 1.0]));
        assert!(near(wheel([0.5, 0.0]), [1.0, 0.5, 0.5]));
        assert!(near(wheel([0.0, 0.0]), [1.0; 3]));
        assert!(near(wheel([3.0, 0.0]), [0.75, 0.0, 0.0]));
        assert_eq!(wheel([f32::NAN, 0.0]), [0.0; 3]);
    }

    #[test]
    fn the_wheel_closes() {
        assert!(near(hue(0.0), hue(1.0)) && near(hue(0.0), hue(0.9999999)));
        assert_eq!(CORNERS.iter().map(|(_, steps)| steps).sum::<f32>(), STEPS);
    }

    #[test]
    fn heat_has_ends() {
        assert_eq!((heat(-1.0), heat(0.0)), (HEAT[0], HEAT[0]));
        assert!(near(heat(1.0), HEAT[4]) && heat(f32::INFINITY) == heat(1.0));
        assert!(near(heat(0.25), HEAT[1]));
        assert!(heat(f32::NAN).iter().all(|value| value.is_finite()));
    }
}
