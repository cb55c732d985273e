// One pass of a stable radix sort over eight bits of the keys: `histogram` per block of 1024, a scan over all of them, and
// `scatter`. Each block is sorted in shared memory first, by the lower and the upper half of the digit: what goes to
// neighbouring places is then written by neighbouring threads.

#import types::{State, group_number}
#import group_scan::{THREADS, Seat, seat_of, scan_threads}

struct SortSettings {
    // 0: as many keys as Gaussians, 1: as many as intersections.
    list: u32,
    // Bit of the key at which the digit starts.
    shift: u32,
}

@group(0) @binding(0) var<uniform> settings: SortSettings;
@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(2) var<storage, read> keys: array<u32>;
@group(0) @binding(3) var<storage, read> values: array<u32>;
// Per digit and block; after the scan sums over blocks of this list, and the sums of all blocks before.
@group(0) @binding(4) var<storage, read_write> counts: array<u32>;
@group(0) @binding(5) var<storage, read> sums: array<u32>;
@group(0) @binding(6) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(7) var<storage, read_write> values_out: array<u32>;

const BLOCK: u32 = 1024u;

fn length() -> u32 {
    return select(state.gaussians, state.intersections, settings.list == 1u);
}

fn digit_of(key: u32) -> u32 {
    return (key >> settings.shift) & 255u;
}

var<workgroup> bins: array<atomic<u32>, 256>;

@compute @workgroup_size(THREADS)
fn histogram(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let block = group_number(group, groups);
    let end = length();
    let blocks = (end + BLOCK - 1u) / BLOCK;
    if block >= blocks {
        return;
    }
    atomicStore(&bins[thread], 0u);
    workgroupBarrier();
    for (var i = 0u; i < BLOCK / THREADS; i++) {
        let place = block * BLOCK + i * THREADS + thread;
        if place < end {
            atomicAdd(&bins[digit_of(keys[place])], 1u);
        }
    }
    workgroupBarrier();
    counts[thread * blocks + block] = atomicLoad(&bins[thread]);
}

// Row `d % 8`, column by thread: how many of the thread's items have half digit d, in the lower half of the word for d < 8
// and in the upper half for the others. After `scan_ranks`, where the thread's first item of that half digit goes.
var<workgroup> ranks: array<u32, 2048>;
// Where each digit starts.
var<workgroup> starts: array<u32, 256>;
// The block's items in the order so far: digit in the upper half, place within the block in the lower half.
var<workgroup> items: array<u32, BLOCK>;

// Sums up all of `ranks`, a thread eight neighbours: no half of a word exceeds the 1024 items of the block.
fn scan_ranks(seat: Seat) {
    let first = 8u * seat.number;
    var sum = 0u;
    for (var i = 0u; i < 8u; i++) {
        sum += ranks[first + i];
    }
    let scan = scan_threads(seat, sum);
    // The upper half digits come behind all of the lower ones.
    var before = scan.before + (scan.total << 16u);
    for (var i = 0u; i < 8u; i++) {
        let own = ranks[first + i];
        ranks[first + i] = before;
        before += own;
    }
    workgroupBarrier();
}

fn count_item(thread: u32, half: u32) {
    ranks[(half & 7u) * THREADS + thread] += 1u << (2u * (half & 8u));
}

// The place of the thread's next item of this half digit.
fn take_place(thread: u32, half: u32) -> u32 {
    let at = (half & 7u) * THREADS + thread;
    let upper = 2u * (half & 8u);
    let place = (ranks[at] >> upper) & 0xffffu;
    ranks[at] += 1u << upper;
    return place;
}

// Sorts the items, four consecutive ones per thread, by the half digit that starts at bit `shift` of an item.
fn sort_items(seat: Seat, mine: vec4<u32>, shift: u32) {
    let thread = seat.number;
    for (var row = 0u; row < 8u; row++) {
        ranks[row * THREADS + thread] = 0u;
    }
    let halves = (mine >> vec4(shift)) & vec4(15u);
    count_item(thread, halves.x);
    count_item(thread, halves.y);
    count_item(thread, halves.z);
    count_item(thread, halves.w);
    workgroupBarrier();
    scan_ranks(seat);
    items[take_place(thread, halves.x)] = mine.x;
    items[take_place(thread, halves.y)] = mine.y;
    items[take_place(thread, halves.z)] = mine.z;
    items[take_place(thread, halves.w)] = mine.w;
    workgroupBarrier();
}

// Items beyond the end have the last digit, and stay behind all others.
fn item(first: u32, place: u32, end: u32) -> u32 {
    if first + place < end {
        return (digit_of(keys[first + place]) << 16u) | place;
    }
    return (255u << 16u) | place;
}

@compute @workgroup_size(THREADS)
fn scatter(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local_index: u32,
) {
    let block = group_number(group, groups);
    let end = length();
    let blocks = (end + BLOCK - 1u) / BLOCK;
    if block >= blocks {
        return;
    }
    let seat = seat_of(local_index);
    let thread = seat.number;
    let first = block * BLOCK;
    let own = 4u * thread;
    let unsorted = vec4(
        item(first, own, end),
        item(first, own + 1u, end),
        item(first, own + 2u, end),
        item(first, own + 3u, end),
    );
    sort_items(seat, unsorted, 16u);
    let half_sorted = vec4(items[own], items[own + 1u], items[own + 2u], items[own + 3u]);
    workgroupBarrier();
    sort_items(seat, half_sorted, 20u);
    for (var place = thread; place < BLOCK; place += THREADS) {
        let digit = items[place] >> 16u;
        if place == 0u || items[place - 1u] >> 16u != digit {
            starts[digit] = place;
        }
    }
    workgroupBarrier();
    for (var place = thread; place < BLOCK; place += THREADS) {
        let digit = items[place] >> 16u;
        let source = first + (items[place] & 0xffffu);
        if source < end {
            let at = digit * blocks + block;
            let to = sums[at / BLOCK] + counts[at] + (place - starts[digit]);
            keys_out[to] = keys[source];
            values_out[to] = values[source];
        }
    }
}
