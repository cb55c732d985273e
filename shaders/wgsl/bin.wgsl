// Stage 2: which footprints each tile sees, nearest first.
//
// The Gaussians are sorted by depth first. `count` and, after a scan of the counts, `emit` go through them in that order with
// one function to decide; the intersections that `emit` writes are then sorted by tile only, and as that sort keeps the order
// of equals, each tile's list is in order of depth, ties by index. An intersection keeps the number that `emit` gave it, its
// slot: those of a Gaussian stand together.

#import types::{View, Step, State, THREADS, TILE, UNSEEN, group_number}
#import tiles::{Reach, unpack_reach, tile_rows, tile_columns}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> state: State;
// Depths and Gaussians in order of depth, and what `project` wrote.
@group(0) @binding(3) var<storage, read> depths: array<u32>;
@group(0) @binding(4) var<storage, read> order: array<u32>;
@group(0) @binding(5) var<storage, read> reaches: array<vec4<f32>>;
// Per rank in order of depth and one more: intersections, after the scan those of all before.
@group(0) @binding(6) var<storage, read_write> counts: array<u32>;
// Per slot: tile, slot, Gaussian.
@group(0) @binding(7) var<storage, read_write> tile_keys: array<u32>;
@group(0) @binding(8) var<storage, read_write> slots: array<u32>;
@group(0) @binding(9) var<storage, read_write> owners: array<u32>;
// Per Gaussian: first slot and number of slots; `project` has filled in those that have none.
@group(0) @binding(10) var<storage, read_write> ranges: array<vec2<u32>>;

@compute @workgroup_size(THREADS)
fn count(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let rank = group_number(group, groups) * THREADS + thread;
    if rank > step.count || state.failed != 0u {
        return;
    }
    var found = 0u;
    if rank < step.count && depths[rank] != UNSEEN {
        let index = order[rank];
        let reach = unpack_reach(reaches[2u * index], reaches[2u * index + 1u]);
        let rows = tile_rows(reach, view);
        for (var row = rows.x; row < rows.y; row++) {
            let columns = tile_columns(reach, row, view);
            found += columns.y - columns.x;
        }
    }
    counts[rank] = found;
}

@compute @workgroup_size(THREADS)
fn emit(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let rank = group_number(group, groups) * THREADS + thread;
    if rank >= step.count || state.failed != 0u {
        return;
    }
    let first = counts[rank];
    let end = counts[rank + 1u];
    let index = order[rank];
    if end == first {
        return;
    }
    ranges[index] = vec2(first, end - first);
    let reach = unpack_reach(reaches[2u * index], reaches[2u * index + 1u]);
    var slot = first;
    let rows = tile_rows(reach, view);
    for (var row = rows.x; row < rows.y; row++) {
        let columns = tile_columns(reach, row, view);
        for (var column = columns.x; column < columns.y && slot < end; column++) {
            tile_keys[slot] = row * view.tiles.x + column;
            slots[slot] = slot;
            owners[slot] = index;
            slot++;
        }
    }
    // Should a compiler round differently in the two entry points, the rest belongs to no tile.
    for (; slot < end; slot++) {
        tile_keys[slot] = view.tiles.x * view.tiles.y;
        slots[slot] = slot;
        owners[slot] = index;
    }
}

// How much work the view is, for the stages that go over intersections; or that there is no room for it.
@group(0) @binding(11) var<storage, read> offsets: array<u32>;
@group(0) @binding(12) var<storage, read_write> plan_state: State;
@group(0) @binding(13) var<storage, read_write> dispatches: array<vec4<u32>>;

fn in_rows(groups: u32) -> vec4<u32> {
    let width = min(groups, 65535u);
    return vec4(width, (groups + 65534u) / 65535u, 1u, 0u);
}

@compute @workgroup_size(1)
fn plan() {
    let needed = offsets[step.count];
    var planned = 0u;
    if plan_state.failed == 0u {
        plan_state.needed = needed;
        if needed > step.capacity {
            plan_state.failed = 1u;
            plan_state.failed_step = step.number;
        } else {
            planned = needed;
        }
    }
    plan_state.intersections = planned;
    // Blocks of the sort, and blocks of the scan of its histogram.
    let blocks = (planned + 1023u) / 1024u;
    dispatches[0] = in_rows(blocks);
    dispatches[1] = in_rows((256u * blocks + 1023u) / 1024u);
}

// Per tile: first place in the sorted list, and one past the last.
@group(0) @binding(14) var<storage, read> sorted_keys: array<u32>;
@group(0) @binding(15) var<storage, read_write> bounds: array<vec2<u32>>;

// The first place whose tile is not below `tile`.
fn lower_bound(tile: u32) -> u32 {
    var low = 0u;
    var high = state.intersections;
    while low < high {
        let middle = low + (high - low) / 2u;
        if sorted_keys[middle] < tile {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    return low;
}

@compute @workgroup_size(THREADS)
fn bound(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group_number(group, groups) * THREADS + thread;
    if tile < view.tiles.x * view.tiles.y {
        bounds[tile] = vec2(lower_bound(tile), lower_bound(tile + 1u));
    }
}
