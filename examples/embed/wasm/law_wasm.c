/* A controller in plain C as a WebAssembly module, for plain.mjs: its numbers lie in the module's memory, `step` reads them
   and writes the others. Nothing is imported, so that the module can do nothing but compute. */

#include "law.h"

#define EXPORTED(name) __attribute__((export_name(name)))

static double sp[LAW_ROOM(LAW_N_SP)], pv[LAW_N_PV], dv[LAW_ROOM(LAW_N_DV)], mv_applied[LAW_N_MV];
static double state[LAW_ROOM(LAW_N_STATE)], operate[LAW_ROOM(LAW_N_OPERATE)], fresh[LAW_N_PV];
static double ahead[LAW_ROOM(LAW_N_AHEAD)];
static double mv[LAW_N_MV], state_next[LAW_ROOM(LAW_N_STATE)], info[LAW_ROOM(LAW_N_INFO)];

/* In the order of LAW_CALL: eight inputs, then three outputs. */
static double *const NUMBERS[] = {sp, pv, dv, mv_applied, state, operate, fresh, ahead, mv, state_next, info};
static const int SIZE[] = {LAW_N_SP,      LAW_N_PV, LAW_N_DV,    LAW_N_MV, LAW_N_STATE, LAW_N_OPERATE,
                           LAW_N_PV,      LAW_N_AHEAD, LAW_N_MV, LAW_N_STATE, LAW_N_INFO};

EXPORTED("numbers") double *numbers(int which) { return NUMBERS[which]; }
EXPORTED("size") int size(int which) { return SIZE[which]; }
EXPORTED("reads") const char *reads(void) { return LAW_READS; }
EXPORTED("sha256") const char *sha256(void) { return LAW_SHA256; }
EXPORTED("step") void step(void) { LAW_CALL(NUMBERS, NUMBERS + 8); }
