use rand::{RngExt as _, SeedableRng as _};

use super::*;

fn noise(seed: u64, count: usize) -> Vec<[f32; 3]> {
    let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    (0..count).map(|_| random.random::<[f32; 3]>().map(|v| 255.0 * v)).collect()
}

fn planes(width: usize, height: usize, colour: impl Fn(usize, usize) -> [f32; 3]) -> Planes {
    let channel = |c: usize| (0..width * height).map(|i| colour(i % width, i / width)[c]).collect();
    Planes::from_interiors(width, height, [channel(0), channel(1), channel(2)])
}

/// A square of noise in front of a wall of noise.
fn square_at(x0: usize, y0: usize) -> Planes {
    let (wall, square) = (noise(2, 61 * 43), noise(3, 12 * 12));
    planes(61, 43, |x, y| match (x.checked_sub(x0), y.checked_sub(y0)) {
        (Some(u @ 0..12), Some(v @ 0..12)) => square[v * 12 + u],
        _ => wall[y * 61 + x],
    })
}

/// Every window of the first image against every one of the second, one number at a time: the best displacement.
fn best_matches(first: &Prepared, second: &Prepared, radius: i32) -> Vec<[i32; 2]> {
    let (width, height) = (first.width as i32, first.height as i32);
    let value = |image: &Prepared, c: usize, x: i32, y: i32| {
        let at = (y + RADIUS as i32) * image.stride as i32 + x + RADIUS as i32;
        i32::from(image.channels[c][at as usize])
    };
    let window = -(RADIUS as i32)..=RADIUS as i32;
    let cost = |x: i32, y: i32, [dx, dy]: [i32; 2]| -> u32 {
        let pixel = |x: i32, y: i32| {
            let square = |c| {
                let difference = value(first, c, x, y) - value(second, c, x + dx, y + dy);
                (difference * difference + (1 << 14)) as u32 >> 15
            };
            (0..CHANNELS).map(square).sum::<u32>().min(u32::from(MOST))
        };
        window
            .clone()
            .flat_map(|v| window.clone().map(move |u| (u, v)))
            .map(|(u, v)| pixel(x + u, y + v))
            .sum()
    };
    let best = |x: i32, y: i32| {
        let inside = |[dx, dy]: &[i32; 2]| (0..width).contains(&(x + dx)) && (0..height).contains(&(y + dy));
        let all = displacements_by_length(radius as usize, radius as usize).into_iter().filter(inside);
        all.min_by_key(|&displacement| cost(x, y, displacement)).unwrap_or_default()
    };
    (0..width * height).map(|i| best(i % width, i / width)).collect()
}

#[test]
fn the_search_agrees_with_one_number_at_a_time_on_every_instruction_set() {
    // Everything changes, so everything is searched; sizes and windows are no whole groups.
    let (wide, other) = (noise(4, 80 * 60), noise(5, 80 * 60));
    let first = planes(37, 21, |x, y| wide[y * 80 + x + 9]);
    let second = planes(37, 21, |x, y| if x < 20 { wide[(y + 3) * 80 + x] } else { other[y * 80 + x] });
    let (a, b) = (Prepared::of(&first), Prepared::of(&second));
    let (there, back) = (best_matches(&a, &b, 11), best_matches(&b, &a, 11));
    for instructions in Instructions::available() {
        let matches = search(instructions, &first, &second, 11);
        for (found, best, other) in [(&matches.forward, &there, &back), (&matches.backward, &back, &there)] {
            for (i, &[dx, dy]) in best.iter().enumerate() {
                let [bx, by] = other[(i as i32 + dy * 37 + dx) as usize];
                let leads_back = (dx + bx).abs() <= 1 && (dy + by).abs() <= 1;
                assert_eq!(found.u[i].is_finite(), leads_back, "{} {i}", instructions.set());
                if leads_back {
                    assert_eq!([found.u[i], found.v[i]], [dx as f32, dy as f32]);
                }
            }
        }
    }
}

#[test]
fn leaving_out_what_rests_loses_no_match() {
    let (first, second) = (square_at(6, 8), square_at(29, 20));
    let (a, b) = (Prepared::of(&first), Prepared::of(&second));
    let (there, back) = (best_matches(&a, &b, 25), best_matches(&b, &a, 25));
    let found = search(Instructions::detect(), &first, &second, 25).forward;
    let mut jumped = 0;
    for (i, &[dx, dy]) in there.iter().enumerate() {
        let [bx, by] = back[(i as i32 + dy * 61 + dx) as usize];
        if (dx + bx).abs() <= 1 && (dy + by).abs() <= 1 {
            assert_eq!([found.u[i], found.v[i]], [dx as f32, dy as f32], "{i}");
            jumped += usize::from([dx, dy] == [23, 12]);
        }
    }
    // Windows that lie inside the square see nothing else.
    assert!(jumped >= 8 * 8, "{jumped}");
}

#[test]
fn only_the_rectangle_of_what_differs_is_searched() {
    let (mut best, mut contrasts) = (Best::new(7 * 5), Best::new(7 * 5));
    contrasts.limit.fill(0);
    best.limit.fill(AT_REST);
    assert_eq!(best.not_at_rest(&contrasts, 7).columns, 0);
    best.limit[7 + 4] = AT_REST + 1;
    best.limit[3 * 7 + 2] = AT_REST + 1;
    let between = Region { first_column: 2, first_row: 1, columns: 3, rows: 3 };
    assert_eq!(best.not_at_rest(&contrasts, 7), between);
    contrasts.limit[7 + 4] = RESTLESS;
    assert_eq!(best.not_at_rest(&contrasts, 7).rows, 1);
    best.limit.fill(u16::MAX);
    contrasts.limit.fill(u16::MAX);
    let all = Region { first_column: 0, first_row: 0, columns: 7, rows: 5 };
    assert_eq!(best.not_at_rest(&contrasts, 7), all);
}

#[test]
fn images_are_prepared_as_stated() {
    // White dots on black are further from their mean than is told apart.
    let (width, height) = (31, 23);
    let dots = |x: usize, y: usize| {
        [[0.0f32; 3], [255.0, 0.0, 90.0]][usize::from(x % 10 / 2 == 2 && y % 9 / 2 == 2)]
    };
    let ramp = |x: usize, y: usize| [x as f32 * 3.0, y as f32 * y as f32 * 0.3, 7.0 * (x % 3) as f32];
    for (colour, clamped) in [(&dots as &dyn Fn(usize, usize) -> [f32; 3], true), (&ramp, false)] {
        let prepared = Prepared::of(&planes(width, height, colour));
        let mean = |of: &dyn Fn(i32, i32) -> f64, x: i32, y: i32, radius: i32| {
            let inside = |&(x, y): &(i32, i32)| (0..31).contains(&x) && (0..23).contains(&y);
            let window =
                (y - radius..=y + radius).flat_map(|y| (x - radius..=x + radius).map(move |x| (x, y)));
            let values: Vec<f64> = window.filter(inside).map(|(x, y)| of(x, y)).collect();
            values.iter().sum::<f64>() / values.len() as f64
        };
        let mut most = 0;
        for (c, channel) in prepared.channels.iter().enumerate() {
            let value = |x: i32, y: i32| f64::from(colour(x as usize, y as usize)[c]);
            let passed = |x: i32, y: i32| value(x, y) - mean(&value, x, y, 6);
            for (i, &short) in channel[..prepared.stride * (height + 4)].iter().enumerate() {
                let x = ((i % prepared.stride) as i32 - 2).clamp(0, 30);
                let y = ((i / prepared.stride) as i32 - 2).clamp(0, 22);
                let smooth = 0.5 * (passed(x, y) + mean(&passed, x, y, 1));
                let expected = 104.5 * (smooth.clamp(-156.0, 156.0) + 156.0);
                // Half a step of rounding, and single precision of sums of 169 values up to 255.
                assert!((f64::from(short) - expected).abs() < 0.6, "{c} {x} {y}: {short}, {expected}");
                most = most.max(short);
            }
        }
        assert_eq!(most == 32_604, clamped, "{most}");
    }
}

#[test]
fn a_faint_square_that_jumps_is_found() {
    // Three grey levels, root mean square, and noise of 0.3, on a flat wall; uniform numbers have half width √3 σ.
    let uniform = |seed: u64, sigma: f32, count: usize| -> Vec<[f32; 3]> {
        let centred = |v: f32| (v / 255.0 - 0.5) * 12.0f32.sqrt() * sigma;
        noise(seed, count).into_iter().map(|colour| colour.map(centred)).collect()
    };
    let square = uniform(6, 3.0, 12 * 12);
    let scene = |x0: usize, seed: u64| {
        let grain = uniform(seed, 0.3, 80 * 45);
        planes(80, 45, |x, y| {
            let faint = match (x.checked_sub(x0), y.checked_sub(15)) {
                (Some(u @ 0..12), Some(v @ 0..12)) => square[v * 12 + u],
                _ => [0.0; 3],
            };
            [0, 1, 2].map(|c| 120.0 + faint[c] + grain[y * 80 + x][c])
        })
    };
    let (first, second) = (scene(20, 7), scene(39, 8));
    let matches = search(Instructions::detect(), &first, &second, 32);
    // Windows that lie inside the square.
    for y in 17..25 {
        for x in 22..30 {
            assert_eq!(matches.forward.at(x, y), [19.0, 0.0], "{x} {y}");
            assert_eq!(matches.backward.at(x + 19, y), [-19.0, 0.0], "{x} {y}");
        }
    }
    let still = search(Instructions::detect(), &first, &scene(20, 9), 32);
    assert!(still.forward.u.iter().all(|&u| u == 0.0), "noise rests");
}

#[test]
fn repetitions_match_alike_both_ways_and_are_not_verified() {
    let stripes = |shift: usize| planes(64, 40, |x, _| [[40.0; 3], [200.0; 3]][(x + shift) / 2 % 2]);
    let (a, b) = (stripes(0), stripes(2));
    let there = search(Instructions::detect(), &a, &b, 20);
    let back = search(Instructions::detect(), &b, &a, 20);
    let bits = |flow: &Flow| -> Vec<u32> { flow.u.iter().chain(&flow.v).map(|v| v.to_bits()).collect() };
    assert_eq!(bits(&there.forward), bits(&back.backward));
    assert_eq!(bits(&there.backward), bits(&back.forward));
    // Two pixels to the left fit as well as two to the right, but one does not lead back by the other. Near the edges
    // only one of them exists.
    let verified = (12..52).filter(|&x| there.forward.at(x, 20)[0].is_finite()).count();
    assert_eq!(verified, 0);
}

#[test]
fn shifts_up_to_the_radius_are_found_both_ways() {
    let (width, height) = (40, 30);
    let wide = noise(1, 100 * 100);
    let crop = |x0: usize, y0: usize| planes(width, height, |x, y| wide[(y0 + y) * 100 + x0 + x]);
    let matches = search(Instructions::detect(), &crop(30, 30), &crop(19, 36), 12);
    let (mut right, mut all) = (0, 0);
    for y in 10..height - 10 {
        for x in 3..width - 15 {
            all += 2;
            right += usize::from(matches.forward.at(x, y) == [11.0, -6.0]);
            right += usize::from(matches.backward.at(x + 11, y - 6) == [-11.0, 6.0]);
        }
    }
    assert_eq!(right, all);
    let limited = search(Instructions::detect(), &crop(30, 30), &crop(19, 36), 5);
    assert!(
        limited.forward.u.iter().chain(&limited.backward.v).all(|value| value.is_nan() || value.abs() <= 5.0)
    );
    assert_eq!(
        search(Instructions::detect(), &crop(0, 0), &crop(0, 0), 12).forward,
        Flow::zeros(width, height)
    );
}
