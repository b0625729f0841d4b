/* Calls through memory, for hosts whose calls take long for each argument. */

#include "segments.h"

#define MOST_ARGUMENTS 9

/* A number of `Function` and its arguments; after the call what it returned is in place of the number. */
static u32 call[1 + MOST_ARGUMENTS];

typedef enum { BEGIN = 0, SEGMENT, PROJECT, IMPLIED_MAP, DEQUANTISE, MOTION, OCCUPANCY, WEIGHTS, POSES } Function;

/* The address of `call`. */
EXPORT(kpc_arguments) u32 *kpc_arguments(void) { return call; }

static u32 result(const u32 *a) {
    const u8 *first = (const u8 *)a[0], *second = (const u8 *)a[1];
    switch (call[0]) {
        case BEGIN: return kpc_begin(a[0], a[1]);
        case SEGMENT: return kpc_segment(a[0], second, a[2], a[3], a[4], a[5], a[6], (u8 *)a[7], (i8 *)a[8]);
        case PROJECT: return kpc_project(first, a[1], a[2], (u8 *)a[3]);
        case IMPLIED_MAP: return kpc_implied_map(first, a[1], a[2], a[3], a[4], a[5], a[6], (u8 *)a[7]);
        case DEQUANTISE:
            return kpc_dequantise((i8 *)a[0], a[1], a[2], (float *)a[3], (float *)a[4], (float *)a[5]);
        case MOTION: return kpc_motion(first, a[1], (u8 *)a[2], a[3]);
        case OCCUPANCY: return kpc_occupancy(first, a[1], (u8 *)a[2], a[3]);
        case WEIGHTS: return kpc_weights(a[0], second, a[2], (u8 *)a[3], a[4]);
        case POSES: return kpc_poses(first, a[1], (u8 *)a[2], a[3]);
        default: return BAD_ARGUMENT;
    }
}

/* Call the function. */
EXPORT(kpc_call) void kpc_call(void) { call[0] = result(call + 1); }
