/* A controller whose law is plain C: law.c steps it, law_signals.h has its names and ranges. Nothing is read from a file,
   and nothing is allocated but the numbers of an instance. */
#include "controller.c"

#include <stdlib.h>

#include "law.h"
#include "law_signals.h"

enum {
  ALL_IN = LAW_N_SP + 2 * LAW_N_PV + LAW_N_DV + LAW_N_MV + LAW_N_STATE + LAW_N_OPERATE + LAW_N_AHEAD,
  ALL_OUT = LAW_N_MV + LAW_N_STATE + LAW_N_INFO,
  REMEMBERED = LAW_N_OPERATE + LAW_N_PV + LAW_N_AHEAD + LAW_N_STATE
};

struct Graph {
  double numbers[ALL_IN + ALL_OUT + REMEMBERED];
};

static bool run_graph(Controller *c) {
  LAW_CALL(c->in, c->out);
  return true;
}

/* The controller of this FMU; `resources` is for those that read a file. On false, c->words says why; close it all the
   same. */
static bool controller_of(Controller *c, const char *resources) {
  static const size_t N_IN[INPUTS] = {LAW_N_SP,    LAW_N_PV,      LAW_N_DV, LAW_N_MV,
                                      LAW_N_STATE, LAW_N_OPERATE, LAW_N_PV, LAW_N_AHEAD};
  static const size_t N_OUT[OUTPUTS] = {LAW_N_MV, LAW_N_STATE, LAW_N_INFO};
  (void)resources;
  *c = (Controller){.period_s = LAW_PERIOD_S,
                    .signals = {{SP_SIGNALS, LAW_N_SP}, {PV_SIGNALS, LAW_N_PV}, {DV_SIGNALS, LAW_N_DV}, {MV_SIGNALS, LAW_N_MV}},
                    .operate_entries = OPERATE_ENTRIES,
                    .ahead_low = AHEAD_LOW,
                    .ahead_high = AHEAD_HIGH};
  memcpy(c->digest, LAW_SHA256, sizeof c->digest);
  if (!(c->graph = calloc(1, sizeof *c->graph))) return failed(c, "no memory");
  double *at = c->graph->numbers;
  for (int i = 0; i < INPUTS; i++) {
    c->uses[i] = LAW_USES[i];
    c->n_in[i] = N_IN[i];
    c->in[i] = at, at += N_IN[i];
  }
  for (int i = 0; i < OUTPUTS; i++) {
    c->n_out[i] = N_OUT[i];
    c->out[i] = at, at += N_OUT[i];
  }
  c->operate = at, at += LAW_N_OPERATE;
  c->fresh = at, at += LAW_N_PV;
  c->ahead = at, at += LAW_N_AHEAD;
  c->state = at;
  for (size_t k = 0; k < c->n_in[OPERATE]; k++) c->operate[k] = c->operate_entries[k].standard;
  for (size_t k = 0; k < c->n_in[FRESH]; k++) c->fresh[k] = 1;
  return true;
}

static void controller_close(Controller *c) { free(c->graph); }
