/* The module's memory: a bump allocator, which the host empties and limits. */

#include "kpc_core.h"
#include "entropy.h"

#define PAGE 65536u
#define ADDRESSES 0xFFFF0000u /* pointers must not wrap around where an array ends */

extern u8 __heap_base;
static u32 top, limit;

/* Return the address of `bytes` bytes, a multiple of 16; 0 where the limit forbids it. */
static u32 allocate(u64 bytes) {
    u64 end = top + ((bytes + 15) & ~(u64)15), held = (u64)__builtin_wasm_memory_size(0) * PAGE;
    u32 found = top;
    if (end > limit) return 0;
    if (end > held && __builtin_wasm_memory_grow(0, (u32)((end - held + PAGE - 1) / PAGE)) == (u32)-1) return 0;
    top = (u32)end;
    return found;
}

/* Begin a call: free all memory that was taken, allow `most` bytes in all, stack and tables included, and return the
   address of `bytes` bytes for arguments and results, a multiple of 16; 0 where the limit forbids it. */
EXPORT(kpc_begin) u32 kpc_begin(u32 most, u32 bytes) {
    top = ((u32)&__heap_base + 15) & ~15u;
    limit = most < ADDRESSES ? most : ADDRESSES;
    prepare_rates();
    return allocate(bytes);
}

u32 mark(void) { return top; }

void *take(u64 bytes) {
    u32 found = bytes < ADDRESSES ? allocate(bytes) : 0;
    if (found) fill((void *)found, 0, (u32)bytes);
    return (void *)found;
}

void release(u32 marked) { top = marked; }
